"""Continuous navigation (Sec. 5.1): how a point moves, and what that is worth.

A point moves in a walled arena, x to the right and y downwards, towards a goal area and past a pit. One step displaces it by

    m = walk(s, s + gain(s) * step_length * a / max(full_action, |a|)),    s' = walk(m, m + noise(s) * xi),    xi ~ N(0, I),

and, on sand, not at all with probability `sand_stuck`: a step, then a slip. Walls stop a movement and let it slide along:
x moves first, as far as the free interval of its row allows, then y in the new column. Gain and noise depend on the ground
where the step begins, and the noise also on the distance to the pit:

    noise^2 = pit_noise^2 exp(-(distance / pit_range)^2) + ice_noise^2 [on ice].

All of this is data (`NavigationParams`): the true domain and the human's belief are two values of it.
"""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp
from flax import struct
from jax import Array

from peps_envs.environment import Bounds, Box, Environment, Step
from peps_envs.navigation.density import NavigationDensity
from peps_envs.navigation.geometry import SLACK, distance, inside, root, walk
from peps_envs.navigation.parameters import NavigationParams
from peps_envs.navigation.scene import agent, ground
from peps_envs.scene import Scene


@struct.dataclass
class NavigationState:
    """Where the agent is, and when."""

    position: Array  # (2,)
    time: Array  # () int, steps since the start


@dataclasses.dataclass(frozen=True)
class Navigation(Environment):
    """Move a point to the goal area; see the module's text. Events: `goal_reached`, `pit_reached`."""

    horizon: int = 200
    waves: int = 2  # wavelengths of the observed sines and cosines: the arena's width twice, once, a half, ...

    action_space = Box(2)
    observation_space = Bounds(-1.0, 1.0)
    event_names = ("goal_reached", "pit_reached")

    @property
    def observation_size(self) -> int:
        return 2 + 4 * self.waves

    def reset(self, key: Array, params: NavigationParams) -> tuple[NavigationState, Array]:
        del key  # one start state
        state = NavigationState(position=jnp.asarray(params.start), time=jnp.zeros((), jnp.int32))
        return state, self.observe(state, params)

    def step(self, key: Array, state: NavigationState, action: Array, params: NavigationParams) -> Step:
        return self.step_from(self.next_state_distribution(state, action, params), key, state, action, params)

    def step_from(
        self, density: NavigationDensity, key: Array, state: NavigationState, action: Array, params: NavigationParams
    ) -> Step:
        position = density.move(key)
        next_state = NavigationState(position=position, time=state.time + 1)
        goal, pit = inside(position, params.goal), inside(position, params.pit)
        return Step(
            state=next_state,
            observation=self.observe(next_state, params),
            reward=self.reward(state, action, next_state, params),
            terminated=goal | pit,
            truncated=(next_state.time >= self.horizon) & ~(goal | pit),
            events=jnp.stack([goal, pit]),
        )

    def reward(
        self, state: NavigationState, action: Array, next_state: NavigationState, params: NavigationParams
    ) -> Array:
        del action  # what counts is where it led
        progress = distance(state.position, params.goal) - distance(next_state.position, params.goal)
        return (
            params.step_reward
            + params.progress_reward * progress
            + params.goal_reward * inside(next_state.position, params.goal)
            + params.pit_reward * inside(next_state.position, params.pit)
        )

    def next_state_distribution(
        self, state: NavigationState, action: Array, params: NavigationParams
    ) -> NavigationDensity:
        position = state.position
        on_ice, on_sand = distance(position, params.ice) <= SLACK, distance(position, params.sand) <= SLACK
        gain = jnp.where(on_sand, params.sand_gain, jnp.where(on_ice, params.ice_gain, 1.0))
        # A step's length is bounded, not its components: the square's corners are no faster. Full length is had below the
        # square's edge already, which a policy that is squashed into it never reaches.
        action = jnp.clip(action, -1.0, 1.0).astype(position.dtype)
        direction = action / jnp.sqrt(jnp.maximum(jnp.sum(action**2), params.full_action**2))
        near_pit = params.pit_noise * jnp.exp(-0.5 * (distance(position, params.pit) / params.pit_range) ** 2)
        return NavigationDensity(
            position=position,
            target=walk(position, position + gain * params.step_length * direction, params),
            noise=root(near_pit**2 + jnp.where(on_ice, params.ice_noise, 0.0) ** 2),
            stuck=jnp.where(on_sand, params.sand_stuck, 0.0),
            params=params,
        )

    def observe(self, state: NavigationState, params: NavigationParams) -> Array:
        """The position, scaled to [-1, 1], with sines and cosines of it.

        The pit's edge is sharp against the arena, and a step is worth little against the pit: without the waves, small
        networks blur the values so much that walking on and standing still look alike.
        """
        scaled = 2 * state.position / params.size - 1
        phases = [0.5 * jnp.pi * 2.0**wave * scaled for wave in range(self.waves)]
        return jnp.concatenate([scaled, *(wave(phase) for phase in phases for wave in (jnp.sin, jnp.cos))])

    def perceive(self, state: NavigationState) -> Array:
        return state.position

    def position_of(self, observation: Array, params: NavigationParams) -> Array:
        """The position (..., 2) that an observation (..., observation_size) was made of."""
        return (observation[..., :2] + 1) / 2 * params.size

    def perception_width(self, params: NavigationParams) -> Array:
        return jnp.broadcast_to(params.perception_width, (2,))

    def scene(self, state: NavigationState, params: NavigationParams) -> Scene:
        """The ground, and where the agent is on it."""
        arena = ground(params)
        return dataclasses.replace(arena, shapes=(*arena.shapes, agent(state.position)))
