"""r-hat: the Bradley-Terry fit, its resamples, and its level."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import Point, settings
from scipy.stats import spearmanr

from peps_jax.learning import surrogate
from peps_jax.learning.surrogate import Examples
from peps_jax.preferences import data
from peps_jax.preferences.data import Answers, Segments

NUMBER = 600


@pytest.fixture(scope="module")
def config(line):
    """A fit of many steps."""
    return settings(
        line.replace(
            surrogate_updates=400, surrogate_batch_size=32, surrogate_learning_rate=1e-2, surrogate_decay=0.0,
            model_hidden_sizes=(16,), prior="none", uniform_answers=0.0,
        )
    ).surrogate  # fmt: skip


STEPS = 5


def random_segments(key, number=NUMBER, mask=None):
    """Pairs of segments with uniform observations and actions."""
    key_observation, key_action = jax.random.split(key)
    shape = (number, 2, STEPS)
    observation = jax.random.uniform(key_observation, (*shape, 1), minval=-1.0)
    action = jax.random.uniform(key_action, (*shape, 1), minval=-1.0)
    point = Point(observation, jnp.zeros(shape, jnp.int32))
    shown = jnp.ones(shape, bool) if mask is None else mask
    return Segments(observation, action, shown, jnp.zeros(shape), point, point)


def numbered(preferred, weight=None):
    """Answers to queries from number 0 on."""
    weight = jnp.ones(preferred.shape) if weight is None else weight
    return Answers(jnp.arange(preferred.shape[0], dtype=jnp.int32), preferred, weight)


def answered(key, segments, rewards):
    """What a rational human who feels `rewards` (n, 2, steps) answers."""
    difference = jnp.subtract(*jnp.moveaxis(jnp.sum(rewards * segments.mask, -1), -1, 0))
    preferred = jax.random.bernoulli(key, jax.nn.sigmoid(difference)).astype(jnp.float32)
    return data.recording(segments, numbered(preferred))


def visited(key, number=512):
    """Uniform observations and actions, and no reward of any."""
    return *jax.random.uniform(key, (2, number, 1), minval=-1.0), jnp.zeros(number)


@jax.jit
def taught(preferences, config):
    key_init, _, key_fit, key_visited = jax.random.split(jax.random.key(7), 4)
    state, info = surrogate.fit(surrogate.init(key_init, config), preferences, key_fit, config)
    return surrogate.pin(state, *visited(key_visited), config), info


def examples_of(segments, preferred):
    """What the loss sees of `segments`."""
    features = jnp.concatenate([segments.observation, segments.action], -1)
    number = segments.mask.shape[0]
    preferred = jnp.broadcast_to(jnp.asarray(preferred, jnp.float32), number)
    return Examples(features, segments.mask, segments.reward, preferred, jnp.ones(number))


def a_member(config):
    """Parameters of an untrained network."""
    return jax.tree.map(lambda leaf: leaf[0], surrogate.init(jax.random.key(0), config).params)


def test_loss_is_log_2_at_a_tie(config):
    params = a_member(config)
    examples = examples_of(random_segments(jax.random.key(1), 6), jnp.array([1.0, 0, 1, 0, 0.5, 1]))
    nothing = jax.tree.map(jnp.zeros_like, params)
    np.testing.assert_allclose(surrogate.loss(nothing, examples, config)[0], math.log(2), rtol=1e-6)
    equal = examples._replace(features=jnp.repeat(examples.features[:, :1], 2, 1))
    value, _ = surrogate.loss(params, equal, config)
    np.testing.assert_allclose(value, math.log(2), rtol=1e-6)


def test_steps_after_a_segments_end_have_no_influence(config):
    mask = jnp.ones((6, 2, STEPS), bool).at[:, 0, 2:].set(False)
    segments = random_segments(jax.random.key(1), 6, mask)
    examples = examples_of(segments, 1.0)
    other = examples._replace(features=jnp.where(mask[..., None], examples.features, 100.0))
    gradient = jax.grad(lambda params, examples: surrogate.loss(params, examples, config)[0])
    each = (jax.tree.leaves(gradient(a_member(config), examples)) for examples in (examples, other))
    for one, two in zip(*each, strict=True):
        np.testing.assert_allclose(one, two, atol=1e-6)
    state = surrogate.init(jax.random.key(0), config)
    assert bool(jnp.any(surrogate.preference_logits(state, segments, config) != 0))


def test_a_tie_counts_half_for_each(config):
    segments = random_segments(jax.random.key(1), 6)
    loss = lambda answer: surrogate.loss(a_member(config), examples_of(segments, answer), config)[0]
    np.testing.assert_allclose(loss(0.5), (loss(0.0) + loss(1.0)) / 2, rtol=1e-6)
    assert float(loss(0.0)) != float(loss(1.0))


def test_an_example_of_no_weight_costs_nothing(config):
    params = a_member(config)
    examples = examples_of(random_segments(jax.random.key(1), 2), 1.0)._replace(weight=jnp.array([0.0, 2.0]))
    value, _ = surrogate.loss(params, examples, config)
    sums = surrogate.segment_sums(params, examples.features, examples.mask, examples.reward, config)
    np.testing.assert_allclose(value, np.logaddexp(0, -(sums[1, 0] - sums[1, 1])), rtol=1e-5)


def test_each_member_draws_from_its_own_resample_in_proportion(config):
    """What nobody has answered is in no minibatch, and a member with an empty resample learns nothing."""
    config = config.replace(updates=50)
    state = surrogate.init(jax.random.key(0), config)
    segments = random_segments(jax.random.key(1), 12)
    segments = segments._replace(reward=jnp.broadcast_to(jnp.arange(12.0)[:, None, None], segments.reward.shape))
    people = (jnp.arange(12) % 4).astype(jnp.float32)  # who answered each
    preferences = data.recording(segments, numbered(jnp.ones(12), people))
    drawn = surrogate._minibatches(state, preferences, jax.random.key(2), config)
    assert drawn.features.shape[:3] == (50, config.ensemble_size, config.batch_size)
    which = np.asarray(drawn.reward[..., 0, 0], int)
    counts = np.asarray(surrogate.counts(state, preferences, config))
    for member in range(config.ensemble_size):
        share = np.bincount(which[:, member].ravel(), minlength=12) / which[:, member].size
        np.testing.assert_allclose(share, counts[:, member] / counts[:, member].sum(), atol=0.05)
        assert not share[counts[:, member] == 0].any()
    alone = preferences.replace(weight=(jnp.arange(12) == np.argmin(counts.min(1) + 100 * (counts.max(1) == 0))) * 1.0)
    empty = np.asarray(surrogate.counts(state, alone, config)).sum(0) == 0
    assert empty.any()
    assert not empty.all()
    taught, _ = surrogate.fit(state, alone, jax.random.key(3), config.replace(decay=jnp.float32(0)))
    for before, after in zip(*map(jax.tree.leaves, (state.params, taught.params)), strict=True):
        np.testing.assert_array_equal(before[empty], after[empty])
        assert not np.array_equal(before[~empty], after[~empty])


def test_resamples_are_poisson_and_follow_from_a_querys_number():
    bootstrap = jax.random.key_data(jax.random.key(3))
    found = np.asarray(surrogate.resampled(bootstrap, jnp.arange(NUMBER), 5))
    assert np.all(found == np.round(found))
    assert abs(found.mean() - 1) < 4 / math.sqrt(found.size)
    assert abs(found.var() - 1) < 0.2
    assert np.any(found[:, 0] != found[:, 1])
    assert abs(np.mean(found == 0) - math.exp(-1)) < 0.05, "what a resample leaves out is a share of 1/e"
    np.testing.assert_array_equal(surrogate.resampled(bootstrap, jnp.array([17, 3]), 5), found[[17, 3]])


def test_places_without_an_answer_weigh_nothing(config):
    """Neither a query that nobody answered nor a place without one, whatever stands there."""
    config = config.replace(updates=20)
    key = jax.random.key(5)
    segments = random_segments(jax.random.key(1), 40)
    preferred = (jnp.arange(40) % 3 == 0).astype(jnp.float32)
    few = data.recording(jax.tree.map(lambda rows: rows[:30], segments), numbered(preferred[:30]))
    wild = segments._replace(
        observation=segments.observation.at[30:].set(1e6), action=segments.action.at[30:].set(-1e6)
    )
    more = data.recording(wild, numbered(preferred, (jnp.arange(40) < 30).astype(jnp.float32)))
    more = more.replace(number=more.number.at[35:].set(data.NOBODY), preferred=more.preferred.at[30:].set(1e6))
    state = surrogate.init(jax.random.key(0), config.replace(validates=True))
    fit = jax.jit(lambda preferences: surrogate.fit(state, preferences, key, config.replace(validates=True)))
    one, two = fit(few), fit(more)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-6), one, two)


def test_it_makes_no_difference_in_which_order_answers_came(config):
    """Rows shuffled, half of them late: at the end the fit is that of a set which had everything from the start."""
    config = config.replace(updates=40)
    segments = random_segments(jax.random.key(1))
    preferred = jax.random.bernoulli(jax.random.key(2), shape=(NUMBER,)).astype(jnp.float32)
    at_once = data.recording(segments, numbered(preferred))
    order = np.random.default_rng(0).permutation(NUMBER)
    late = jax.tree.map(lambda rows: rows[order], data.recording(segments, numbered(preferred, jnp.zeros(NUMBER))))
    numbers = np.random.default_rng(1).permutation(NUMBER)
    for now, some in ((0, numbers[: NUMBER // 2]), (7, numbers[NUMBER // 2 :])):
        late = data.file(late, Answers(jnp.asarray(some), preferred[some], jnp.ones(len(some))), jnp.asarray(now))
    state = surrogate.init(jax.random.key(0), config)
    counts = lambda preferences: surrogate.counts(state, preferences, config)
    np.testing.assert_array_equal(counts(late), counts(at_once)[order])  # a member's resample holds the same queries
    fit = jax.jit(lambda preferences: surrogate.fit(state, preferences, jax.random.key(5), config))
    jax.tree.map(
        lambda one, two: np.testing.assert_allclose(one, two, rtol=1e-6, atol=1e-7),
        fit(at_once), fit(data.known(late, jnp.asarray(7))),
    )  # fmt: skip
    early = fit(data.known(late, jnp.asarray(6)))[0]
    assert not np.allclose(jax.tree.leaves(early.params)[1], jax.tree.leaves(fit(at_once)[0].params)[1])


def test_an_answer_of_three_people_counts_as_three(config):
    state = surrogate.init(jax.random.key(0), config)
    segments = random_segments(jax.random.key(1), 2)
    three = data.recording(segments, numbered(jnp.array([1.0, 0.0]), jnp.array([3.0, 1.0])))
    each = data.recording(segments, Answers(jnp.array([0, 0, 1, 0]), jnp.array([1.0, 1.0, 0.0, 1.0]), jnp.ones(4)))
    jax.tree.map(np.testing.assert_array_equal, three, each)
    copies = surrogate.resampled(state.bootstrap, jnp.arange(2), config.ensemble_size)
    np.testing.assert_array_equal(surrogate.counts(state, three, config), copies * np.array([[3.0], [1.0]]))


def test_an_answer_of_three_people_costs_as_much_as_three_equal_answers(config):
    """In the loss and in its gradient."""
    params = a_member(config)
    segments = random_segments(jax.random.key(1), 4)
    preferred = jnp.array([1.0, 0.0, 0.5, 1.0])
    weighed = data.recording(segments, numbered(preferred, jnp.array([3.0, 1.0, 2.0, 1.0])))
    each = jnp.array([0, 0, 0, 1, 2, 2, 3])
    copied = data.recording(segments, numbered(preferred))
    copied = jax.tree.map(lambda rows: rows[each], copied)
    cost = lambda params, rows: surrogate.loss(params, surrogate._examples(rows, config), config)
    (value, accuracy), gradient = jax.value_and_grad(cost, has_aux=True)(params, weighed)
    (same, as_accurate), expected = jax.value_and_grad(cost, has_aux=True)(params, copied)
    np.testing.assert_allclose([value, accuracy], [same, as_accurate], rtol=1e-6)
    jax.tree.map(lambda one, two: np.testing.assert_allclose(one, two, rtol=1e-4, atol=1e-7), gradient, expected)
    alone = data.recording(segments, numbered(preferred))
    assert abs(float(cost(params, alone)[0] - value)) > 1e-5, "how many people say so counts"


def test_fit_recovers_the_ranking_of_a_linear_reward(config):
    segments = random_segments(jax.random.key(1))
    reward = lambda observation, action: 2 * observation[..., 0] - action[..., 0]
    preferences = answered(jax.random.key(2), segments, reward(segments.observation, segments.action))
    state, info = taught(preferences, config)
    seen = visited(jax.random.key(3))
    learned = surrogate.predict(state, *seen, config)
    assert spearmanr(learned, reward(*seen[:2])).statistic > 0.95
    assert float(info["surrogate_loss"]) < math.log(2)
    assert float(info["preference_accuracy"]) > 0.7


def test_unequal_lengths_identify_the_level(config):
    cost = -0.7
    key_length, key_segments, key_answer = jax.random.split(jax.random.key(4), 3)
    length = jax.random.randint(key_length, (NUMBER, 2, 1), 1, STEPS + 1)
    mask = jnp.arange(STEPS)[None, None] < length
    segments = random_segments(key_segments, mask=mask)
    state, _ = taught(answered(key_answer, segments, jnp.full(mask.shape, cost)), config)
    learned = surrogate.predict(state, *visited(jax.random.key(3)), config)
    assert abs(float(jnp.mean(learned)) - cost) < 0.2


@pytest.mark.parametrize("level", ["none", "quantile", "max"])
def test_level_is_pinned_over_replay(config, level):
    segments = random_segments(jax.random.key(1))
    preferences = answered(jax.random.key(2), segments, segments.observation[..., 0])
    config = config.replace(level=level, updates=5)
    state, _ = taught(preferences, config)
    seen = visited(jax.random.split(jax.random.key(7), 4)[3])  # what `taught` has visited
    learned = np.asarray(surrogate.predict(state, *seen, config))
    if level == "none":
        assert set(np.asarray(state.shift)) == {0.0}
        assert set(np.asarray(state.scale)) == {1.0}
    if level == "max":
        np.testing.assert_allclose(learned.max(), 0.0, atol=5e-2 * np.ptp(learned))
    if level == "quantile":
        np.testing.assert_allclose(np.quantile(learned, [0.05, 0.95]), [-1.0, 0.0], atol=0.15)


def test_the_level_standard_normalises_every_member(config):
    segments = random_segments(jax.random.key(1))
    preferences = answered(jax.random.key(2), segments, segments.observation[..., 0])
    state, _ = taught(preferences, config.replace(updates=5, level="standard"))
    seen = visited(jax.random.key(7), number=4096)
    raw = surrogate.member_rewards(state, *seen, config)
    np.testing.assert_allclose(raw.mean(-1), state.shift, atol=0.15 * float(state.scale.max()))
    np.testing.assert_allclose(raw.std(-1), state.scale, rtol=0.15)
    learned = surrogate.predict(state, *seen, config)
    by_hand = np.mean((raw - np.asarray(state.shift)[:, None]) / np.asarray(state.scale)[:, None], 0)
    np.testing.assert_allclose(learned, by_hand, rtol=1e-4, atol=1e-5)


# --- a prior ----------------------------------------------------------------------------------------------------------------


def bounded(config, bound):
    return config.replace(prior="observed", bound=bound)


@pytest.mark.parametrize("bound", [0.01, 0.5, 50.0, math.inf])
def test_untaught_it_is_the_reward_that_was_observed(config, bound):
    config = bounded(config, bound)
    state = surrogate.init(jax.random.key(0), config)
    observation, action, _ = visited(jax.random.key(3))
    observed = 30 * observation[..., 0]
    nothing = state.replace(params=jax.tree.map(jnp.zeros_like, state.params))
    np.testing.assert_allclose(surrogate.predict(nothing, observation, action, observed, config), observed, atol=2e-5)
    near = surrogate.predict(state, observation, action, observed, config)
    np.testing.assert_allclose(near, observed, atol=0.5)
    plain = config.replace(prior="none")
    without = [surrogate.predict(state, observation, action, reward, plain) for reward in (observed, 0 * observed)]
    np.testing.assert_array_equal(*without)


@pytest.mark.parametrize("bound", [0.01, 0.5, 3.0])
def test_nothing_is_worth_much_more_than_it_pays(config, bound):
    config = bounded(config, bound)
    sure = jax.tree.map(lambda leaf: 1e3 * leaf, surrogate.init(jax.random.key(0), config).params)
    state = surrogate.init(jax.random.key(0), config).replace(params=sure)
    observation, action, nothing = visited(jax.random.key(3))
    above = np.asarray(surrogate.predict(state, observation, action, nothing, config))
    assert np.isfinite(above).all()
    assert above.max() <= bound + 1e-6
    assert above.min() < -10.0, "and it may be worth as little as it likes"


def test_a_prior_makes_few_answers_enough(config):
    """Someone who wants what pays, and minds the right side: what differs from the prior is little, and soon learned."""
    few = jnp.arange(NUMBER) < 60
    pays = lambda observation, action: 4 * jnp.sin(9 * observation[..., 0]) + 4 * jnp.sin(9 * action[..., 0])
    minds = lambda observation: -3.0 * (observation[..., 0] > 0)
    segments = random_segments(jax.random.key(1))
    observed = pays(segments.observation, segments.action)
    segments = segments._replace(reward=observed)
    preferences = answered(jax.random.key(2), segments, observed + minds(segments.observation))
    preferences = preferences.replace(weight=preferences.weight * few)
    observation, action, _ = visited(jax.random.key(3))
    seen = observation, action, pays(observation, action)
    true = seen[-1] + minds(observation)
    error = {}
    for name, own in {"observed": bounded(config, 0.5), "none": config}.items():
        state, _ = taught(preferences, own.replace(decay=jnp.float32(1e-2)))
        learned = surrogate.predict(state, *seen, own)
        error[name] = float(jnp.mean((learned - true) ** 2))
    assert error["observed"] < 0.5 * float(jnp.mean(minds(observation) ** 2)), "better than the prior alone"
    assert error["observed"] < 0.2 * error["none"]


def test_uniform_answers_bound_the_likelihood(config):
    difference = jnp.array([-200.0, -1.0, 0.0, 1.0, 200.0])
    logits = surrogate.answer_logits(difference, 0.1)
    expected = 0.05 + 0.9 / (1 + np.exp(-np.asarray(difference, np.float64)))
    np.testing.assert_allclose(jax.nn.sigmoid(logits), expected, rtol=1e-4)
    slope = jax.vmap(jax.grad(lambda value: surrogate.answer_logits(value, 0.1)))(difference)
    assert bool(jnp.all(jnp.isfinite(slope)))
    np.testing.assert_array_equal(surrogate.answer_logits(difference, 0.0), difference)

    examples = examples_of(random_segments(jax.random.key(1), 6), 0.0)
    sure = jax.tree.map(lambda leaf: 1e3 * leaf, a_member(config))
    loss = lambda config: float(surrogate.loss(sure, examples, config)[0])
    assert loss(config) > -math.log(0.05)
    assert loss(config.replace(uniform_answers=0.1)) <= -math.log(0.05) + 1e-5, "an error costs at most this"


@pytest.mark.parametrize(("noisy", "grows"), [(True, True), (False, False)])
def test_weight_decay_follows_the_validation_loss(config, noisy, grows):
    """Up where members learn random answers by heart, down where what they learn holds for all."""
    segments = random_segments(jax.random.key(1))
    preferences = answered(jax.random.key(2), segments, 5 * segments.observation[..., 0])
    if noisy:
        coins = jax.random.bernoulli(jax.random.key(3), shape=(NUMBER,)).astype(jnp.float32)
        few = (jnp.arange(NUMBER) < 60).astype(jnp.float32)
        preferences = preferences.replace(preferred=coins, weight=few)
    config = config.replace(decay=jnp.float32(1e-2), learning_rate=jnp.float32(3e-2 if noisy else 1e-3))
    state, info = taught(preferences, config.replace(validates=True))
    ratio = float(info["surrogate_validation_ratio"])
    low, high = surrogate.VALIDATION_RATIO
    assert ratio > high if grows else ratio < low
    factor = surrogate.DECAY_STEP if grows else 1 / surrogate.DECAY_STEP
    np.testing.assert_allclose([state.decay, info["surrogate_decay"]], 1e-2 * factor, rtol=1e-5)
    plain, _ = taught(preferences, config)
    np.testing.assert_allclose(plain.decay, 1e-2, rtol=1e-6)
    jax.tree.map(lambda one, two: np.testing.assert_allclose(one, two, rtol=1e-4), plain.params, state.params)
