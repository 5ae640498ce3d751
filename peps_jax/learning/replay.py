"""Replay: everything that happened in a training, in the order of its rounds.

Rounds write at a position that follows from the round's index, which is the same for every cell of a batch. So under `vmap`
a write stays one slice of the buffer instead of a scatter, and nothing is ever overwritten: the capacity is a whole training.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import Array

import peps_envs
from peps_jax.trajectory import Transition


def init(capacity: int, environment: peps_envs.Environment) -> Transition:
    """An empty buffer of `capacity` transitions."""
    discrete = isinstance(environment.action_space, peps_envs.Discrete)
    return Transition(
        observation=jnp.zeros((capacity, environment.observation_size)),
        action=jnp.zeros(capacity, jnp.int32) if discrete else jnp.zeros((capacity, environment.action_space.size)),
        reward=jnp.zeros(capacity),
        next_observation=jnp.zeros((capacity, environment.observation_size)),
        terminated=jnp.zeros(capacity),
    )


def add(buffer: Transition, transitions: Transition, position: Array) -> Transition:
    """Writes `transitions` (n, ...) at `position`; the buffer's rows before it are the past."""
    return jax.tree.map(
        lambda rows, new: jax.lax.dynamic_update_slice_in_dim(rows, new, position, 0), buffer, transitions
    )


def sample(buffer: Transition, key: Array, shape: tuple[int, ...], filled: Array) -> Transition:
    """Transitions of shape `shape` drawn uniformly, with replacement, from the first `filled` rows."""
    index = jax.random.randint(key, shape, 0, filled)
    return jax.tree.map(lambda rows: rows[index], buffer)
