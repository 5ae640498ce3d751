"""Evaluation: episodes of a policy, scored by the explicability metric."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jax import Array

from peps_jax import explicability, generator
from peps_jax.config import Problem
from peps_jax.explicability import Score
from peps_jax.settings import AgentSettings
from peps_jax.train import Result, policy_of

Policy = Callable[[Array, Array | None], tuple[Array, Array]]  # (observation, key or None) -> action, l_pi


@struct.dataclass
class Evaluation:
    """Episodes, one entry each: (num_episodes,). Events of the environment are attributes too, e.g. `goal_reached`."""

    score: Score
    log_policy: Array  # sum of log pi(a|s) relative to the uniform policy
    length: Array  # steps
    events: dict[str, Array]  # bool
    perceived: Array  # (num_episodes, horizon + 1, perceived_size) the route; the last place is repeated after the end

    @property
    def return_(self) -> Array:
        """sum r_A."""
        return self.score.return_

    @property
    def human_return(self) -> Array:
        """sum r_H."""
        return self.score.human_return

    @property
    def log_belief(self) -> Array:
        """sum l_H."""
        return self.score.log_belief

    @property
    def log_true(self) -> Array:
        """sum l_A."""
        return self.score.log_true

    @property
    def belief_gap(self) -> Array:
        """sum (l_H - l_A)."""
        return self.score.belief_gap

    @property
    def explicability(self) -> Array:
        """sum r_H + sum (l_H - l_A)."""
        return self.score.explicability

    @property
    def explicability_with_policy(self) -> Array:
        """The whole of Eq. (4): explicability - sum l_pi."""
        return self.score.explicability - self.log_policy

    def __getattr__(self, name: str) -> Array:
        events = self.__dict__.get("events", {})
        if name in events:
            return events[name]
        raise AttributeError(f"Evaluation has no {name!r}; this environment's events are {', '.join(events)}")


def evaluate(
    result: Result,
    num_episodes: int = 100,
    *,
    problem: Problem | None = None,
    stochastic: bool = False,
    key: Array | None = None,
) -> Evaluation:
    """Rolls out a learned policy and scores it. Pure.

    Args:
      result: of `train`.
      num_episodes: how many.
      problem: domain to act in and belief to be scored by; those of the training by default. "human_expectation" acts in the
        believed domain.
      stochastic: act by samples instead of the policy's mode.
      key: random key; by default one that follows from the training's seed and differs from the training's.
    """
    problem = result.training.problem if problem is None else problem
    key = jax.random.fold_in(generator.key(result.config.seed), 1) if key is None else key
    return _evaluate(result.agents, result.training.settings.agent, problem, key, num_episodes, stochastic)


@functools.partial(jax.jit, static_argnames=("num_episodes", "stochastic"))
def _evaluate(
    agents: Any, settings: AgentSettings, problem: Problem, key: Array, num_episodes: int, stochastic: bool
) -> Evaluation:
    return evaluate_policy(policy_of(agents, settings), problem, key, num_episodes, stochastic=stochastic)


def evaluate_policy(
    policy: Policy, problem: Problem, key: Array, num_episodes: int, *, stochastic: bool = False
) -> Evaluation:
    """`num_episodes` episodes of `policy` in `problem`, scored for a human who believes its belief."""
    environment, params = problem.environment, problem.params

    def step(state: Any, observation: Array, alive: Array, key: Array) -> tuple[tuple[Any, Array, Array], Any]:
        key_act, key_env = jax.random.split(key)
        action, log_policy = policy(observation, key_act if stochastic else None)
        after, score, _ = explicability.judged_step(problem, key_env, state, action)
        hold = lambda new, old: jax.tree.map(lambda new, old: jnp.where(alive, new, old), new, old)
        next_state, next_observation = hold(after.state, state), hold(after.observation, observation)
        still = alive & ~(after.terminated | after.truncated)
        row = (score, log_policy, jnp.ones((), jnp.float32), after.events)
        row = jax.tree.map(lambda values: jnp.where(alive, values, jnp.zeros_like(values)), row)
        return (next_state, next_observation, still), (row, environment.perceive(next_state))

    key_reset, key_steps = jax.vmap(jax.random.split, out_axes=1)(jax.random.split(key, num_episodes))
    state, observation = jax.vmap(environment.reset, in_axes=(0, None))(key_reset, params)
    keys = jax.vmap(lambda key: jax.random.split(key, environment.horizon), out_axes=1)(key_steps)
    # steps of all episodes, rather than all steps of an episode: a batch of scans would be traced three times
    together = lambda carry, keys: jax.vmap(step)(*carry, keys)
    _, (rows, places) = jax.lax.scan(together, (state, observation, jnp.ones(num_episodes, bool)), keys)
    score, log_policy, length = jax.tree.map(lambda values: jnp.sum(values, 0), rows[:3])
    events = jnp.any(rows[3], 0)
    places = jnp.concatenate([jax.vmap(environment.perceive)(state)[None], places])
    return Evaluation(
        score=score,
        log_policy=log_policy,
        length=length,
        events={name: events[:, place] for place, name in enumerate(environment.event_names)},
        perceived=jnp.moveaxis(places, 0, 1).astype(jnp.float32),
    )
