"""Environments of this package as gymnax environments. Importing this module imports gymnax.

    task = peps_envs.make("nav-d1")
    env = GymnaxEnvironment(task.environment, task.params)
    params = env.default_params  # what is true; env.default_params.replace(domain=belief) is what a human believes

    observation, state = env.reset(key, params)
    observation, state, reward, terminated, truncated, info = env.step(key_step, state, action, params)

`terminated` and `truncated` are what the environment says. As in gymnax, `step` begins a new episode where one is over, and `info`
holds the `final_observation`; beside it are the events of the step by their names.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from gymnax.environments import environment as gymnax
from gymnax.environments import spaces
from jax import Array

from peps_envs.environment import Discrete, Environment


@struct.dataclass
class GymnaxState(gymnax.EnvState):
    """The environment's state, and what gymnax asks of one."""

    time: Array  # () int, steps since the start
    state: Any
    observation: Array  # (observation_size,)
    terminated: Array  # () bool
    truncated: Array  # () bool


@struct.dataclass
class GymnaxParams(gymnax.EnvParams):
    """`domain` holds the environment's parameters. Its time limit is its horizon, whatever `max_steps_in_episode` says."""

    domain: Any = None
    max_steps_in_episode: int = 1


class GymnaxEnvironment(gymnax.Environment[GymnaxState, GymnaxParams]):
    """`environment`, whose parameters are `params` unless it is given others."""

    def __init__(self, environment: Environment, params: Any):
        super().__init__()
        self.environment, self.params = environment, params

    @property
    def default_params(self) -> GymnaxParams:
        return GymnaxParams(domain=self.params, max_steps_in_episode=self.environment.horizon)

    def reset_env(self, key: Array, params: GymnaxParams) -> tuple[Array, GymnaxState]:
        state, observation = self.environment.reset(key, params.domain)
        no = jnp.zeros((), bool)
        return observation, GymnaxState(jnp.zeros((), jnp.int32), state, observation, no, no)

    def step_env(
        self, key: Array, state: GymnaxState, action: Array, params: GymnaxParams
    ) -> tuple[Array, GymnaxState, Array, Array, dict[str, Array]]:
        after = self.environment.step(key, state.state, action, params.domain)
        moved = GymnaxState(state.time + 1, after.state, after.observation, after.terminated, after.truncated)
        info = {name: after.events[place] for place, name in enumerate(self.environment.event_names)}
        info["discount"] = self.discount(moved, params)
        return after.observation, moved, after.reward, after.terminated, info

    def observe(self, key: Array, state: GymnaxState, action: Array | None, params: GymnaxParams) -> Array:
        return state.observation

    def is_terminated(self, state: GymnaxState, params: GymnaxParams) -> Array:
        return state.terminated

    def is_truncated(self, state: GymnaxState, params: GymnaxParams) -> Array:
        return state.truncated

    @property
    def name(self) -> str:
        return type(self.environment).__name__

    @property
    def num_actions(self) -> int:
        return self.environment.action_space.size

    def action_space(self, params: GymnaxParams | None = None) -> spaces.Box | spaces.Discrete:
        space = self.environment.action_space
        return spaces.Discrete(space.size) if isinstance(space, Discrete) else spaces.Box(-1.0, 1.0, (space.size,))

    def observation_space(self, params: GymnaxParams | None = None) -> spaces.Box:
        domain = self.params if params is None else params.domain
        _, observation = jax.eval_shape(self.environment.reset, jax.random.key(0), domain)
        bounds = self.environment.observation_space
        low, high = (
            np.broadcast_to(np.asarray(limit, observation.dtype), observation.shape)
            for limit in (bounds.low, bounds.high)
        )
        return spaces.Box(low, high, observation.shape, observation.dtype)
