"""Environments of this package as Brax environments. Importing this module imports Brax; nothing else here does.

    from brax.envs.wrappers import training

    task = peps_envs.make("nav-d1")
    env = training.wrap(BraxEnvironment(task.environment, task.params), episode_length=task.environment.horizon)

`done` says *terminated* alone. Time is Brax's own business: its `EpisodeWrapper` ends episodes at `episode_length` and writes
`info["truncation"]`, which is right only if nobody has counted time into `done` before. What the environment says is in `info`:

    info["terminated"]  the MDP ended,
    info["truncated"]   the environment's own horizon is reached or passed; the episode goes on until a wrapper ends it,
    info["key"]         the random key of the next step.

`metrics` holds the environment's events as 0.0 or 1.0, so that Brax's wrappers count them per episode.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from brax.envs.base import Env, State
from jax import Array

from peps_envs.environment import Box, Environment, Step


class BraxEnvironment(Env):
    """`environment` with the dynamics and rewards of `params`: the true ones or a belief's.

    Keys may be new (`jax.random.key`) or old (`jax.random.PRNGKey`); Brax's `EpisodeWrapper` around a batch takes old ones only.

    Raises:
      ValueError: the actions aren't continuous, which Brax has no word for.
    """

    def __init__(self, environment: Environment, params: Any):
        if not isinstance(environment.action_space, Box):
            raise ValueError(
                f"action_space {environment.action_space!r}: Brax knows continuous actions only; choose a Box"
            )
        self.environment = environment
        self.params = params

    def reset(self, rng: Array) -> State:
        key, key_reset = jax.random.split(rng)
        state, observation = self.environment.reset(key_reset, self.params)
        no = jnp.zeros((), bool)
        nothing = jnp.zeros(len(self.environment.event_names), bool)
        start = Step(state, observation, reward=jnp.zeros(()), terminated=no, truncated=no, events=nothing)
        return self._state(start, key, State(None, observation, start.reward, no))

    def step(self, state: State, action: Array) -> State:
        # the key isn't part of the environment's state: AutoResetWrapper puts that back, and every episode would repeat the first
        key, key_step = jax.random.split(state.info["key"])
        after = self.environment.step(key_step, state.pipeline_state, action, self.params)
        return self._state(after, key, state)

    def _state(self, step: Step, key: Array, before: State) -> State:
        """Brax's view of `step`; what wrappers wrote into `before`'s metrics and info stays."""
        events = {name: step.events[i].astype(jnp.float32) for i, name in enumerate(self.environment.event_names)}
        return before.replace(
            pipeline_state=step.state,
            obs=step.observation,
            reward=step.reward,
            done=step.terminated.astype(jnp.float32),
            metrics=before.metrics | events,
            info=before.info | {"key": key, "terminated": step.terminated, "truncated": step.truncated},
        )

    @property
    def observation_size(self) -> int:
        return self.environment.observation_size

    @property
    def action_size(self) -> int:
        return self.environment.action_space.size

    @property
    def backend(self) -> str:
        """Brax's name for what computes the physics; no engine of Brax's own does."""
        return "peps_envs"
