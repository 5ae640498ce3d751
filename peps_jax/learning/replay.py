"""Replay: everything that happened in a training, in the order of its rounds.

Rounds write at a position that follows from the round's index, which is the same for every run of a batch. So under `vmap`
a write stays one slice of the buffer instead of a scatter, and nothing is ever overwritten: the capacity is a whole training.
"""

from __future__ import annotations

import chex
import jax
import jax.numpy as jnp
from jax import Array

from peps_envs import ActionSpace, Discrete
from peps_jax import generator
from peps_jax.trajectory import Transition


def init(
    capacity: int,
    observation_size: int,
    action_space: ActionSpace,
    perceived_size: int,
    *,
    told: bool = True,
    imagines: bool = False,
) -> Transition:
    """An empty buffer of `capacity` transitions, with what the human thinks of each if that is `told`, and what it `imagines`."""
    numbers = lambda *shape: jnp.zeros((capacity, *shape), jnp.float32)
    discrete = isinstance(action_space, Discrete)
    return Transition(
        observation=numbers(observation_size),
        action=jnp.zeros(capacity, jnp.int32) if discrete else numbers(action_space.size),
        reward=numbers(),
        next_observation=numbers(observation_size),
        movement=numbers(perceived_size),
        terminated=jnp.zeros(capacity, bool),
        human_reward=numbers() if told else None,
        log_belief=numbers() if told else None,
        imagined=numbers(perceived_size) if imagines else None,
    )


def add(buffer: Transition, transitions: Transition, position: Array) -> Transition:
    """Writes `transitions` (n, ...) at `position`; the buffer's rows before it are the past."""
    chex.assert_trees_all_equal_shapes(
        *(jax.tree.map(lambda rows: rows[:0], tree) for tree in (buffer, transitions)),  # but for how many there are
    )
    write = lambda rows, new: jax.lax.dynamic_update_slice_in_dim(rows, new.astype(rows.dtype), position, 0)
    return jax.tree.map(write, buffer, transitions)


def sample(buffer: Transition, key: Array, shape: tuple[int, ...], filled: Array) -> Transition:
    """Transitions of shape `shape` drawn uniformly, with replacement, from the first `filled` rows."""
    return rows(buffer, draw(key, shape, filled))


def draw(key: Array, shape: tuple[int, ...], filled: Array) -> Array:
    """Which rows `sample` takes, (*shape)."""
    return generator.integers(key, shape, 0, filled)


def rows(buffer: Transition, index: Array) -> Transition:
    """The transitions in rows `index` (...)."""
    return jax.tree.map(lambda rows: rows[index], buffer)
