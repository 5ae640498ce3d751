"""Replay: what is written is read, and nothing else."""

import jax
import jax.numpy as jnp
import numpy as np

from peps_envs import Box, Discrete
from peps_jax.learning import replay
from peps_jax.trajectory import Transition


def numbered(start, number):
    """Transitions that say in every field which they are."""
    index = jnp.arange(start, start + number, dtype=jnp.float32)
    return Transition(
        index[:, None], index[:, None], index, index[:, None], index[:, None], index % 2 == 1, index, index
    )


def test_add_writes_at_its_position_and_nowhere_else():
    buffer = replay.init(10, 1, Box(1), 1)
    buffer = replay.add(buffer, numbered(1, 4), 0)
    buffer = replay.add(buffer, numbered(5, 4), jnp.asarray(4))
    np.testing.assert_array_equal(buffer.reward, [1, 2, 3, 4, 5, 6, 7, 8, 0, 0])
    np.testing.assert_array_equal(buffer.observation[:, 0], buffer.reward)


def test_sample_draws_whole_transitions_uniformly_from_the_filled_rows():
    buffer = replay.add(replay.init(10, 1, Box(1), 1), numbered(0, 10), 0)
    batch = replay.sample(buffer, jax.random.key(0), (20, 100), 5)
    assert batch.observation.shape == (20, 100, 1)
    for rows in (batch.observation, batch.action, batch.next_observation, batch.movement):
        np.testing.assert_array_equal(rows[..., 0], batch.reward)
    np.testing.assert_array_equal(batch.terminated, batch.reward % 2 == 1)
    share = np.bincount(np.asarray(batch.reward, int).ravel(), minlength=10) / 2000
    np.testing.assert_allclose(share[:5], 0.2, atol=0.05)
    np.testing.assert_array_equal(share[5:], 0)


def test_discrete_actions_are_whole_numbers():
    buffer = replay.init(3, 1, Discrete(4), 1)
    assert buffer.action.shape == (3,)
    assert jnp.issubdtype(buffer.action.dtype, jnp.integer)
