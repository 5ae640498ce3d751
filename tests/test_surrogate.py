"""r-hat: the Bradley-Terry fit, its resamples, and its level."""

import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import Point
from scipy.stats import spearmanr

from peps_jax.learning import surrogate
from peps_jax.trajectory import Preferences, Segments, Transition

NUMBER = 600


@pytest.fixture(scope="module")
def config(line):
    """One round that learns from all preferences at once."""
    return line.replace(
        total_steps=40, num_queries=NUMBER, surrogate_updates=400, surrogate_batch_size=64, surrogate_learning_rate=1e-2,
        surrogate_decay=0.0, model_hidden_sizes=(16,),
    )  # fmt: skip


def random_segments(key, config, number=NUMBER, mask=None):
    """Pairs of segments with uniform observations and actions."""
    key_observation, key_action = jax.random.split(key)
    shape = (number, 2, config.segment_length)
    observation = jax.random.uniform(key_observation, (*shape, 1), minval=-1.0)
    action = jax.random.uniform(key_action, (*shape, 1), minval=-1.0)
    point = Point(observation, jnp.zeros(shape, jnp.int32))
    return Segments(observation, action, jnp.ones(shape) if mask is None else mask, point, point)


def answered(key, segments, rewards):
    """What a rational human who feels `rewards` (n, 2, steps) answers."""
    difference = jnp.subtract(*jnp.moveaxis(jnp.sum(rewards * segments.mask, -1), -1, 0))
    answers = jax.random.bernoulli(key, jax.nn.sigmoid(difference)).astype(jnp.float32)
    return Preferences(segments, answers, jnp.ones_like(answers))


def visited(key, number=512):
    """Replay with uniform observations and actions."""
    observation, action = jax.random.uniform(key, (2, number, 1), minval=-1.0)
    zeros = jnp.zeros(number)
    return Transition(observation, action, zeros, observation, zeros)


@functools.partial(jax.jit, static_argnames="recipe")
def taught(preferences, config, recipe=surrogate.PLAIN):
    key_init, key_add, key_fit, key_visited = jax.random.split(jax.random.key(7), 4)
    state = surrogate.add(surrogate.init(key_init, config), preferences, 0, key_add, config)
    return surrogate.fit(state, visited(key_visited), NUMBER, 512, key_fit, config, recipe)


def queries_of(segments, config):
    """The arguments of the loss that stand for `segments`."""
    return jnp.concatenate([segments.observation, segments.action], -1), segments.mask


def test_loss_is_log_2_at_a_tie(config):
    state = surrogate.init(jax.random.key(0), config)
    features, mask = queries_of(random_segments(jax.random.key(1), config, 6), config)
    answers, weights = jnp.array([1.0, 0, 1, 0, 0.5, 1]), jnp.ones((6, config.ensemble_size))
    nothing = jax.tree.map(jnp.zeros_like, state.params)
    np.testing.assert_allclose(
        surrogate.loss(nothing, features, mask, answers, weights, config)[0], math.log(2), rtol=1e-6
    )
    equal = jnp.repeat(features[:, :1], 2, 1)
    value, _ = surrogate.loss(state.params, equal, mask, answers, weights, config)
    np.testing.assert_allclose(value, math.log(2), rtol=1e-6)


def test_steps_after_a_segments_end_have_no_influence(config):
    state = surrogate.init(jax.random.key(0), config)
    mask = jnp.ones((6, 2, config.segment_length)).at[:, 0, 2:].set(0.0)
    segments = random_segments(jax.random.key(1), config, 6, mask)
    features, _ = queries_of(segments, config)
    other = jnp.where(mask[..., None] > 0, features, 100.0)
    answers, weights = jnp.ones(6), jnp.ones((6, config.ensemble_size))
    gradient = jax.grad(lambda *arguments: surrogate.loss(*arguments, config)[0])
    for one, two in zip(
        jax.tree.leaves(gradient(state.params, features, mask, answers, weights)),
        jax.tree.leaves(gradient(state.params, other, mask, answers, weights)),
        strict=True,
    ):
        np.testing.assert_allclose(one, two, atol=1e-6)
    assert bool(jnp.any(surrogate.preference_logits(state, segments, config) != 0))


def test_a_tie_counts_half_for_each(config):
    state = surrogate.init(jax.random.key(0), config)
    features, mask = queries_of(random_segments(jax.random.key(1), config, 6), config)
    loss = lambda answer: surrogate.loss(
        state.params, features, mask, jnp.full(6, answer), jnp.ones((6, config.ensemble_size)), config
    )[0]
    np.testing.assert_allclose(loss(0.5), (loss(0.0) + loss(1.0)) / 2, rtol=1e-6)
    assert float(loss(0.0)) != float(loss(1.0))


def test_weights_choose_what_a_member_sees(config):
    state = surrogate.init(jax.random.key(0), config)
    features, mask = queries_of(random_segments(jax.random.key(1), config, 2), config)
    weights = jnp.zeros((2, config.ensemble_size)).at[1, 0].set(2.0)
    value, _ = surrogate.loss(state.params, features, mask, jnp.array([1.0, 1.0]), weights, config)
    sums = surrogate.segment_sums(state.params, features, mask, config)
    np.testing.assert_allclose(value, np.logaddexp(0, -(sums[0, 1, 0] - sums[0, 1, 1])), rtol=1e-5)


def test_resamples_are_poisson_and_only_of_answers(config):
    config = config.replace(num_queries=NUMBER - 100, total_steps=40)
    segments = random_segments(jax.random.key(1), config)
    skipped = jnp.ones(NUMBER).at[:100].set(0.0)
    state = surrogate.init(jax.random.key(0), config.replace(num_queries=NUMBER))
    state = surrogate.add(state, Preferences(segments, jnp.ones(NUMBER), skipped), 0, jax.random.key(2), config)
    weights = np.asarray(state.weights)
    assert np.all(weights[:100] == 0), "skipped"
    assert np.all(weights[-100:] == 0), "beyond the budget"
    asked = weights[100:-100]
    assert np.all(asked == np.round(asked))
    assert abs(asked.mean() - 1) < 4 / math.sqrt(asked.size)
    assert abs(asked.var() - 1) < 0.2
    assert np.any(asked[:, 0] != asked[:, 1])


def test_fit_recovers_the_ranking_of_a_linear_reward(config):
    segments = random_segments(jax.random.key(1), config)
    reward = lambda observation, action: 2 * observation[..., 0] - action[..., 0]
    preferences = answered(jax.random.key(2), segments, reward(segments.observation, segments.action))
    state, info = taught(preferences, config)
    seen = visited(jax.random.key(3))
    learned = surrogate.predict(state, seen.observation, seen.action, config)
    assert spearmanr(learned, reward(seen.observation, seen.action)).statistic > 0.95
    assert float(info["surrogate_loss"]) < math.log(2)
    assert float(info["preference_accuracy"]) > 0.7


def test_unequal_lengths_identify_the_level(config):
    cost = -0.7
    key_length, key_segments, key_answer = jax.random.split(jax.random.key(4), 3)
    length = jax.random.randint(key_length, (NUMBER, 2, 1), 1, config.segment_length + 1)
    mask = (jnp.arange(config.segment_length)[None, None] < length).astype(jnp.float32)
    segments = random_segments(key_segments, config, mask=mask)
    state, _ = taught(answered(key_answer, segments, jnp.full(mask.shape, cost)), config)
    seen = visited(jax.random.key(3))
    learned = surrogate.predict(state, seen.observation, seen.action, config)
    assert abs(float(jnp.mean(learned)) - cost) < 0.2


@pytest.mark.parametrize("level", ["none", "quantile", "max"])
def test_level_is_pinned_over_replay(config, level):
    segments = random_segments(jax.random.key(1), config)
    preferences = answered(jax.random.key(2), segments, segments.observation[..., 0])
    config = config.replace(level=level, surrogate_updates=5)
    state, _ = taught(preferences, config)
    seen = visited(jax.random.split(jax.random.key(7), 4)[3])  # what `taught` has in replay
    learned = np.asarray(surrogate.predict(state, seen.observation, seen.action, config))
    if level == "none":
        assert set(np.asarray(state.shift)) == {0.0}
        assert set(np.asarray(state.scale)) == {1.0}
    if level == "max":
        np.testing.assert_allclose(learned.max(), 0.0, atol=5e-2 * np.ptp(learned))
    if level == "quantile":
        np.testing.assert_allclose(np.quantile(learned, [0.05, 0.95]), [-1.0, 0.0], atol=0.15)


def test_the_level_standard_normalises_every_member(config):
    segments = random_segments(jax.random.key(1), config)
    preferences = answered(jax.random.key(2), segments, segments.observation[..., 0])
    state, _ = taught(preferences, config.replace(surrogate_updates=5), surrogate.Recipe(level="standard"))
    seen = visited(jax.random.key(7), number=4096)
    raw = surrogate.member_rewards(state, seen.observation, seen.action, config)
    np.testing.assert_allclose(raw.mean(-1), state.shift, atol=0.15 * float(state.scale.max()))
    np.testing.assert_allclose(raw.std(-1), state.scale, rtol=0.15)
    learned = surrogate.predict(state, seen.observation, seen.action, config)
    by_hand = np.mean((raw - np.asarray(state.shift)[:, None]) / np.asarray(state.scale)[:, None], 0)
    np.testing.assert_allclose(learned, by_hand, rtol=1e-4, atol=1e-5)


def test_uniform_answers_bound_the_likelihood(config):
    recipe = surrogate.Recipe(uniform_answers=0.1)
    difference = jnp.array([-200.0, -1.0, 0.0, 1.0, 200.0])
    logits = surrogate.answer_logits(difference, recipe)
    expected = 0.05 + 0.9 / (1 + np.exp(-np.asarray(difference, np.float64)))
    np.testing.assert_allclose(jax.nn.sigmoid(logits), expected, rtol=1e-4)
    slope = jax.vmap(jax.grad(lambda value: surrogate.answer_logits(value, recipe)))(difference)
    assert bool(jnp.all(jnp.isfinite(slope)))
    np.testing.assert_array_equal(surrogate.answer_logits(difference, surrogate.PLAIN), difference)

    state = surrogate.init(jax.random.key(0), config)
    features, mask = queries_of(random_segments(jax.random.key(1), config, 6), config)
    sure = jax.tree.map(lambda leaf: 1e3 * leaf, state.params)
    arguments = (sure, features, mask, jnp.zeros(6), jnp.ones((6, config.ensemble_size)), config)
    assert float(surrogate.loss(*arguments)[0]) > -math.log(0.05)
    assert float(surrogate.loss(*arguments, recipe)[0]) <= -math.log(0.05) + 1e-5, "an error costs at most this"


def test_what_a_resample_leaves_out_is_a_share_of_1_over_e(config):
    segments = random_segments(jax.random.key(1), config)
    state = surrogate.init(jax.random.key(0), config)
    state = surrogate.add(
        state, Preferences(segments, jnp.ones(NUMBER), jnp.ones(NUMBER)), 0, jax.random.key(2), config
    )
    assert abs(float(jnp.mean(state.weights == 0)) - math.exp(-1)) < 0.05


@pytest.mark.parametrize(("noisy", "grows"), [(True, True), (False, False)])
def test_weight_decay_follows_the_validation_loss(config, noisy, grows):
    """Up where members learn random answers by heart, down where what they learn holds for all."""
    segments = random_segments(jax.random.key(1), config)
    preferences = answered(jax.random.key(2), segments, 5 * segments.observation[..., 0])
    if noisy:
        coins = jax.random.bernoulli(jax.random.key(3), shape=(NUMBER,)).astype(jnp.float32)
        few = (jnp.arange(NUMBER) < 60).astype(jnp.float32)
        preferences = preferences._replace(answers=coins, answered=few)
    config = config.replace(surrogate_decay=1e-2, surrogate_learning_rate=3e-2 if noisy else 1e-3)
    state, info = taught(preferences, config, surrogate.Recipe(validates=True))
    ratio = float(info["surrogate_validation_ratio"])
    low, high = surrogate.VALIDATION_RATIO
    assert ratio > high if grows else ratio < low
    factor = surrogate.DECAY_STEP if grows else 1 / surrogate.DECAY_STEP
    np.testing.assert_allclose([state.decay, info["surrogate_decay"]], 1e-2 * factor, rtol=1e-5)
    plain, _ = taught(preferences, config)
    np.testing.assert_allclose(plain.decay, 1e-2, rtol=1e-6)
    jax.tree.map(lambda one, two: np.testing.assert_allclose(one, two, rtol=1e-4), plain.params, state.params)
