"""Statistics: rliable's definitions (Agarwal et al. 2021), by hand, by scipy and by numbers that rliable itself gives."""

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy import stats

from peps_jax.analysis.intervals import estimate, interquartile_mean, mean, probability_of_improvement

matrices = arrays(np.float64, st.tuples(st.integers(2, 6), st.just(3)), elements=st.integers(-5, 5).map(float))


def test_interquartile_mean_by_hand():
    assert interquartile_mean([[0.0], [1.0], [2.0], [100.0]]) == 1.5
    assert interquartile_mean([[0.0, -50.0], [1.0, 2.0]]) == 0.5
    assert interquartile_mean([[1.0], [2.0], [3.0]]) == 2.0, "three scores have no quarter to leave out"
    # tasks are pooled: it is not the mean of each task's own
    assert interquartile_mean(np.stack([np.arange(4.0), 100 + np.arange(4.0)], -1)) == (2 + 3 + 100 + 101) / 4


@given(scores=matrices)
def test_interquartile_mean_is_the_trimmed_mean(scores):
    np.testing.assert_allclose(interquartile_mean(scores), stats.trim_mean(scores, 0.25, axis=None), atol=1e-12)


@given(scores=matrices, others=matrices)
def test_probability_of_improvement_is_mann_whitneys(scores, others):
    by_task = [
        stats.mannwhitneyu(x, y, alternative="greater").statistic / (x.size * y.size)
        for x, y in zip(scores.T, others.T, strict=True)
    ]
    np.testing.assert_allclose(probability_of_improvement(scores, others), np.mean(by_task), atol=1e-12)
    np.testing.assert_allclose(
        probability_of_improvement(scores, others) + probability_of_improvement(others, scores), 1.0
    )
    np.testing.assert_allclose(
        probability_of_improvement(np.exp(scores), np.exp(others)), probability_of_improvement(scores, others)
    )


def test_probability_of_improvement_by_hand():
    assert probability_of_improvement([[1.0], [2.0]], [[0.0], [0.5], [0.7]]) == 1.0
    assert probability_of_improvement([[1.0], [3.0]], [[2.0], [3.0]]) == (0 + 0 + 1 + 0.5) / 4
    assert probability_of_improvement([[1.0, 0.0]], [[0.0, 1.0]]) == 0.5, "better on one task and worse on the other"


@pytest.mark.parametrize("statistic", [mean, interquartile_mean])
def test_statistics_take_leading_axes(statistic):
    scores = np.random.default_rng(0).normal(size=(5, 2, 7, 3))
    each = [[statistic(own) for own in row] for row in scores]
    np.testing.assert_allclose(statistic(scores), each)


def test_intervals_are_the_bootstraps_exact_quantiles():
    """All 16 resamples of two runs on two tasks, enumerated."""
    scores = np.array([[0.0, 10.0], [1.0, 13.0]])
    runs = range(2)
    every = [
        np.mean([scores[a, 0], scores[b, 0], scores[c, 1], scores[d, 1]])
        for a, b, c, d in itertools.product(runs, repeat=4)
    ]
    found = estimate(mean, scores, draws=200_000, confidence=0.8)
    assert found.value == 6.0
    np.testing.assert_allclose([found.low, found.high], np.quantile(every, [0.1, 0.9], method="inverted_cdf"))


def test_resamples_stay_within_their_task():
    scores = np.array([[0.0, 100.0]] * 5)
    assert estimate(mean, scores) == (50.0, 50.0, 50.0)
    assert estimate(probability_of_improvement, scores, scores - 1) == (1.0, 1.0, 1.0)


def test_intervals_cover():
    """The mean of 20 runs: about 95 of 100 intervals hold the truth, and their width is that of a t interval."""
    random = np.random.default_rng(1)
    found = [estimate(mean, random.normal(3.0, 2.0, (20, 1)), draws=2000, seed=seed) for seed in range(200)]
    assert 0.88 < np.mean([one.low <= 3.0 <= one.high for one in found]) < 0.98
    np.testing.assert_allclose(np.mean([one.high - one.low for one in found]), 2 * 1.96 * 2.0 / 20**0.5, rtol=0.08)


def test_estimates_are_rliables():
    """What rliable 1.2.0 gives for these scores (50 000 draws), up to the chance of two bootstraps."""
    random = np.random.default_rng(0)
    scores, others = random.normal(1.0, 1.0, (10, 4)), random.normal(0.5, 1.0, (12, 4))
    np.testing.assert_allclose(estimate(interquartile_mean, scores, draws=50_000), (0.92073, 0.6808, 1.1756), atol=0.01)
    np.testing.assert_allclose(
        estimate(probability_of_improvement, scores, others, draws=50_000), (0.53125, 0.40625, 0.6521), atol=0.006
    )


def test_the_same_seed_gives_the_same_interval():
    scores = np.random.default_rng(0).normal(size=(10, 2))
    assert estimate(interquartile_mean, scores) == estimate(interquartile_mean, scores)
    assert estimate(interquartile_mean, scores) != estimate(interquartile_mean, scores, seed=1)


@pytest.mark.parametrize(
    ("scores", "message"),
    [
        (np.zeros(4), "give \\(runs, tasks\\)"),
        (np.zeros((1, 4)), "two runs or more"),
        (np.zeros((2, 3, 4)), "two runs or more"),
        (np.array([[np.nan], [1.0]]), "nan or inf"),
    ],
)
def test_bad_scores_are_refused(scores, message):
    with pytest.raises(ValueError, match=message):
        estimate(interquartile_mean, scores)


def test_two_methods_need_the_same_tasks():
    with pytest.raises(ValueError, match="scores of 3 and of 4 tasks"):
        probability_of_improvement(np.zeros((2, 3)), np.zeros((2, 4)))
