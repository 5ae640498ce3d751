"""What is worth asking, and what a candidate is."""

import math

import hypothesis
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import Point, settings
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from peps_jax.preferences import queries
from peps_jax.trajectory import Trajectory, Transition

logits = hnp.arrays(np.float32, (4, 6), elements=st.floats(-30, 30, width=32))


@hypothesis.settings(max_examples=30, deadline=None)
@given(logits)
def test_information_gain_is_between_0_and_log_2(logits):
    gain = queries.information_gain(jnp.asarray(logits))
    assert gain.shape == (6,)
    assert bool(jnp.all((gain >= 0) & (gain <= math.log(2) + 1e-5)))


def test_information_gain_is_0_where_members_agree():
    agree = jnp.array([[-50.0, -1.0, 0.0, 3.0, 50.0]] * 3)
    np.testing.assert_allclose(queries.information_gain(agree), 0.0, atol=1e-6)
    np.testing.assert_allclose(queries.disagreement(agree), 0.0, atol=1e-12)


def test_information_gain_by_hand():
    entropy = lambda p: -p * math.log(p) - (1 - p) * math.log(1 - p)
    first, second = 0.9, 0.4
    odds = jnp.array([[math.log(p / (1 - p))] for p in (first, second)])
    expected = entropy((first + second) / 2) - (entropy(first) + entropy(second)) / 2
    np.testing.assert_allclose(queries.information_gain(odds), [expected], rtol=1e-5)
    np.testing.assert_allclose(queries.disagreement(odds), [((first - second) / 2) ** 2], rtol=1e-5)


def test_certain_members_that_contradict_tell_log_2():
    np.testing.assert_allclose(queries.information_gain(jnp.array([[40.0], [-40.0]])), [math.log(2)], rtol=1e-6)


@pytest.mark.parametrize("strategy", ["information_gain", "disagreement", "random"])
def test_a_chosen_batch_has_no_repeats(line, strategy):
    config = settings(line.replace(query_strategy=strategy)).queries
    key_logits, key_places, key = jax.random.split(jax.random.key(0), 3)
    distinct = 2 * config.per_round
    places = jnp.tile(jax.random.normal(key_places, (distinct, 3)), (3, 1))  # each three times
    scores = jnp.tile(3 * jax.random.normal(key_logits, (4, distinct)), (1, 3))
    chosen = queries.choose(scores, places, key, config)
    assert chosen.shape == (config.per_round,)
    assert len(set(np.asarray(chosen).tolist())) == config.per_round
    assert len(set((np.asarray(chosen) % distinct).tolist())) == config.per_round, "a near-duplicate was taken"


def test_the_most_informative_comes_first(line):
    scores = jnp.array([[0.0, 5.0, 0.1, 1.0, 2.0, 0.2, 0.3], [0.0, -5.0, 0.1, -1.0, 2.0, 0.2, 0.3]])
    chosen = queries.choose(scores, jnp.arange(7.0)[:, None], jax.random.key(0), settings(line).queries)
    assert chosen[0] == 1
    assert chosen[1] == 3


def test_no_candidate_is_taken_twice_while_others_are_left(line):
    """Two kinds of candidates, 600 in all: duplicates come last, but each is a pair of its own."""
    config = settings(line.replace(num_queries=60 * line.num_rounds)).queries
    kinds = jnp.arange(600) % 2
    logits = jnp.stack([3.0 * kinds, -3.0 * kinds])
    chosen = np.asarray(queries.choose(logits, kinds[:, None].astype(jnp.float32), jax.random.key(0), config))
    assert len(set(chosen.tolist())) == 60
    assert chosen[0] % 2 == 1, "the informative kind comes first"
    assert chosen[1] % 2 == 0, "its duplicates come after what is new"


@pytest.mark.parametrize("strategy", ["information_gain", "disagreement"])
def test_ties_are_broken_at_random(line, strategy):
    config = settings(line.replace(query_strategy=strategy)).queries
    first = lambda seed: int(
        queries.choose(jnp.zeros((3, 50)), jnp.arange(50.0)[:, None], jax.random.key(seed), config)[0]
    )
    assert len({first(seed) for seed in range(8)}) > 3


def collected(steps=10, num_envs=3, ends=()):
    """A trajectory whose observations say where they come from: 100 environment + step."""
    place = 100.0 * jnp.arange(num_envs)[None] + jnp.arange(steps)[:, None]
    over = jnp.zeros((steps, num_envs), bool)
    for step, env, kind in ends:
        over = over.at[step, env].set(kind == "truncated")
    terminated = jnp.zeros((steps, num_envs), bool)
    for step, env, kind in ends:
        terminated = terminated.at[step, env].set(kind == "terminated")
    place = place[..., None]
    point = Point(place, jnp.zeros((steps, num_envs), jnp.int32))
    transition = Transition(
        place, jnp.zeros_like(place), jnp.zeros((steps, num_envs)), place + 1, jnp.ones_like(place), terminated,
        jnp.zeros((steps, num_envs)), jnp.zeros((steps, num_envs)),
    )  # fmt: skip
    return Trajectory(
        transition, over, jnp.zeros((steps, num_envs, 1), bool), jnp.zeros((steps, num_envs, 2)), point, point
    )


def test_candidates_are_pieces_of_one_environment(line):
    config = settings(line.replace(num_queries=400, min_segment_length=2)).queries
    pairs = jax.jit(queries.candidates)(collected(), jax.random.key(0), config)
    number = config.per_round * config.candidates_per_query
    assert pairs.mask.shape == (number, 2, config.segment_length)
    np.testing.assert_array_equal(jnp.diff(pairs.observation[..., 0], axis=-1), 1)
    lengths = np.asarray(jnp.sum(pairs.mask, -1))
    assert set(np.unique(lengths)) == {2, 3, 4, 5}
    assert bool(jnp.all(jnp.diff(pairs.mask.astype(int), axis=-1) <= 0)), "a mask that has ended doesn't start again"
    assert set(np.unique(pairs.observation[:, :, 0] // 100)) == {0, 1, 2}


def test_candidates_come_from_watched_environments_only(line):
    config = settings(line.replace(num_queries=400)).queries
    trajectory = collected()
    trajectory = trajectory._replace(worth=trajectory.worth[:, :2])
    pairs = jax.jit(queries.candidates)(trajectory, jax.random.key(0), config)
    assert set(np.unique(pairs.observation[:, :, 0] // 100)) == {0, 1}


@pytest.mark.parametrize("kind", ["terminated", "truncated"])
def test_a_candidate_ends_with_its_episode(line, kind):
    config = settings(line.replace(num_queries=400, min_segment_length=5)).queries
    pairs = jax.jit(queries.candidates)(
        collected(ends=[(4, 0, kind), (4, 1, kind), (4, 2, kind)]), jax.random.key(0), config
    )
    start = pairs.observation[:, :, 0, 0] % 100
    expected = jnp.where(start <= 4, 5 - start, 5)
    np.testing.assert_array_equal(jnp.sum(pairs.mask, -1), expected)


def test_describe_ignores_what_is_masked(line):
    pairs = queries.candidates(collected(), jax.random.key(0), settings(line.replace(min_segment_length=1)).queries)
    hidden = pairs._replace(observation=jnp.where(pairs.mask[..., None], pairs.observation, 1e6))
    np.testing.assert_array_equal(queries.describe(pairs), queries.describe(hidden))
