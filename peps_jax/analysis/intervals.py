"""Statistics over runs and tasks with intervals, by rliable's definitions.

Agarwal et al. 2021, "Deep Reinforcement Learning at the Edge of the Statistical Precipice". Scores are arrays (runs, tasks): a
run is a training with a seed of its own, a task an environment. A statistic takes (..., runs, tasks) and gives (...), so that all
resamples of a bootstrap are one call.

    estimate(interquartile_mean, scores)                     # of one method
    estimate(probability_of_improvement, scores, others)     # of one over another
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike


class Estimate(NamedTuple):
    """A statistic of the scores themselves, and its interval."""

    value: float
    low: float
    high: float


def mean(scores: ArrayLike) -> np.ndarray:
    """Mean over runs and tasks."""
    return np.mean(_checked(scores), (-2, -1))


def interquartile_mean(scores: ArrayLike) -> np.ndarray:
    """Mean of the middle half of all scores, runs and tasks pooled: the lowest and the highest quarter are left out.

    Of n scores, floor(n / 4) are left out at either end (a 25 % trimmed mean).
    """
    scores = _checked(scores)
    pooled = np.sort(scores.reshape(*scores.shape[:-2], -1), -1)
    cut = pooled.shape[-1] // 4
    return np.mean(pooled[..., cut : pooled.shape[-1] - cut], -1)


def probability_of_improvement(scores: ArrayLike, others: ArrayLike) -> np.ndarray:
    """P(a run of one method scores higher than a run of another), mean over tasks; a tie counts half.

    On a task it is the Mann-Whitney statistic over all pairs of runs, U / (n m). The two may have different numbers of runs.
    """
    scores, others = _checked(scores), _checked(others)
    if scores.shape[-1] != others.shape[-1]:
        raise ValueError(f"scores of {scores.shape[-1]} and of {others.shape[-1]} tasks: give both the same tasks")
    difference = np.sign(scores[..., :, None, :] - others[..., None, :, :])
    return np.mean(0.5 + 0.5 * difference, (-3, -2, -1))


def estimate(
    statistic: Callable[..., np.ndarray],
    *scores: ArrayLike,
    draws: int = 10_000,
    confidence: float = 0.95,
    seed: int = 0,
) -> Estimate:
    """A statistic and its stratified bootstrap interval (percentiles).

    A resample draws runs with replacement, for every task and every method by itself: tasks are fixed, seeds are chance.

    Args:
      statistic: of one or more arrays (..., runs, tasks).
      scores: those arrays, (runs, tasks) each; at least two runs.
      draws: resamples.
      confidence: share of them that lies within the interval.
      seed: of the resampling.

    Raises:
      ValueError: scores that are not (runs, tasks) with two runs or more, or not finite.
    """
    random = np.random.default_rng(seed)
    resamples = []
    for own in map(_checked, scores):
        if own.ndim != 2 or own.shape[0] < 2:
            raise ValueError(f"scores of shape {own.shape}: a bootstrap needs (runs, tasks) with two runs or more")
        chosen = random.integers(own.shape[0], size=(draws, *own.shape))
        resamples.append(np.take_along_axis(own[None], chosen, 1))
    tails = (1 - confidence) / 2
    low, high = np.quantile(statistic(*resamples), [tails, 1 - tails])
    return Estimate(value=float(statistic(*scores)), low=float(low), high=float(high))


def _checked(scores: ArrayLike) -> np.ndarray:
    scores = np.asarray(scores, np.float64)
    if scores.ndim < 2:
        raise ValueError(f"scores of shape {scores.shape}: give (runs, tasks)")
    if not np.all(np.isfinite(scores)):
        raise ValueError("scores hold nan or inf: say what a failed run counts as before comparing")
    return scores
