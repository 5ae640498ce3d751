"""A policy's episode, state by state; what a human expected in it; and how humans of other beliefs judge the policy."""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from peps_jax import generator
from peps_jax.config import Problem
from peps_jax.evaluate import evaluate_policy
from peps_jax.settings import AgentSettings
from peps_jax.train import Result, policy_of


class Episode(NamedTuple):
    """What happened from a start to an end; states after the end are the last one again."""

    states: Any  # (horizon + 1, ...) the environment's
    actions: Array  # (horizon, ...)
    length: Array  # () int, steps until the end


def episode(result: Result, key: Array) -> Episode:
    """An episode of what was learned, by the policy's mode."""
    training = result.training
    return _episode(result.agents, training.settings.agent, training.problem, key)


@jax.jit
def _episode(agents: Any, settings: AgentSettings, problem: Problem, key: Array) -> Episode:
    environment, params, policy = problem.environment, problem.params, policy_of(agents, settings)

    def move(carry: tuple[Any, Array, Array], key: Array) -> tuple[Any, Any]:
        state, observation, alive = carry
        action = policy(observation, None)[0]
        after = environment.step(key, state, action, params)
        hold = lambda new, old: jax.tree.map(lambda new, old: jnp.where(alive, new, old), new, old)
        state, observation = hold((after.state, after.observation), (state, observation))
        return (state, observation, alive & ~(after.terminated | after.truncated)), (state, action, alive)

    key_start, key_moves = jax.random.split(key)
    state, observation = environment.reset(key_start, params)
    keys = jax.random.split(key_moves, environment.horizon)
    _, (later, actions, alive) = jax.lax.scan(move, (state, observation, jnp.ones((), bool)), keys)
    states = jax.tree.map(lambda first, rest: jnp.concatenate([first[None], rest]), state, later)
    return Episode(states, actions, jnp.sum(alive))


@functools.partial(jax.jit, static_argnames="ahead")
def expected(problem: Problem, seen: Episode, ahead: int) -> Any:
    """Where a human expected things to be, who saw the state `ahead` steps before and knows what was done since.

    At each time the believed dynamics start from what truly was there then: what is wrong about them hasn't added up for longer.

    Returns:
      States (horizon + 1, ...); of the first ones, what was expected from the start on.
    """
    environment, horizon = problem.environment, seen.actions.shape[0]

    def at(time: Array) -> Any:
        time = jnp.minimum(time, seen.length)
        begin = jnp.maximum(time - ahead, 0)

        def move(state: Any, step: Array) -> tuple[Any, None]:
            action = seen.actions[jnp.minimum(begin + step, horizon - 1)]
            after = environment.step(jax.random.key(0), state, action, problem.belief).state
            return jax.tree.map(lambda new, old: jnp.where(begin + step < time, new, old), after, state), None

        return jax.lax.scan(move, jax.tree.map(lambda rows: rows[begin], seen.states), jnp.arange(ahead))[0]

    return jax.vmap(at)(jnp.arange(horizon + 1))


def judged(result: Result, beliefs: Any, num_episodes: int) -> Array:
    """The explicability of what was learned, in the true domain, for humans of other `beliefs` (n, ...): (n, num_episodes)."""
    training = result.training
    key = jax.random.fold_in(generator.key(training.config.seed), 1)  # as in `evaluate`
    return _judged(result.agents, training.settings.agent, training.problem, beliefs, key, num_episodes)


@functools.partial(jax.jit, static_argnames="num_episodes")
def _judged(
    agents: Any, settings: AgentSettings, problem: Problem, beliefs: Any, key: Array, num_episodes: int
) -> Array:
    policy = policy_of(agents, settings)
    judge = lambda belief: evaluate_policy(policy, problem.replace(belief=belief), key, num_episodes).explicability
    return jax.vmap(judge)(beliefs)
