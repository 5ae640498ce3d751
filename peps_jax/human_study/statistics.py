"""Statistics of what people said: agents' ratings, agreement between people, and whether a person answers with care.

Raters see every agent, so their ratings are an array (raters, agents), a row for each person, without gaps. The main test is the
repeated-measures one; the one-way ANOVA, which the paper reports, takes the columns for different people.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from peps_jax.analysis.intervals import Estimate

LEVELS = ("nominal", "ordinal", "interval", "ratio")
DRAWS = 10_000  # resamples of a bootstrap


# --- do the agents differ? ------------------------------------------------------------------------------------------------


class Anova(NamedTuple):
    """An analysis of variance."""

    f: float
    df: float  # degrees of freedom, of the agents
    df_error: float
    p: float
    eta_squared: float  # share of the variance that lies between agents; partial, of repeated measures


class RepeatedMeasures(NamedTuple):
    """A repeated-measures ANOVA, and its correction where differences between agents vary unequally."""

    anova: Anova  # eta_squared is the partial one
    epsilon: float  # Greenhouse-Geisser's, 1 where no correction is needed
    corrected_p: float


class Friedman(NamedTuple):
    """Friedman's test, which looks at each rater's order of the agents alone."""

    chi_squared: float
    df: int
    p: float
    concordance: float  # Kendall's W, 1 where all raters have one order


class Pair(NamedTuple):
    """Two agents compared."""

    first: int  # columns
    second: int
    difference: float  # mean of the first less that of the second
    p: float  # as the test corrects it


class SignedRanks(NamedTuple):
    """Wilcoxon's signed-rank test of two agents."""

    first: int
    second: int
    difference: float  # mean of the first less that of the second
    statistic: float  # the smaller sum of ranks
    p: float
    corrected_p: float  # Holm's, over all pairs
    rank_biserial: float  # from -1 to 1: how much of the ranks speaks for the first


def one_way(ratings: ArrayLike) -> Anova:
    """The paper's test: as if every agent had been rated by people of its own."""
    from scipy import stats

    ratings = _complete(ratings)
    raters, agents = ratings.shape
    df, df_error = agents - 1, agents * (raters - 1)
    with np.errstate(divide="ignore", invalid="ignore"):
        between = raters * np.sum((ratings.mean(0) - ratings.mean()) ** 2)
        within = np.sum((ratings - ratings.mean(0)) ** 2)
        if within == 0:
            return _without_error(between, df, df_error)
        found = stats.f_oneway(*ratings.T)
    share = between / (between + within)
    return Anova(float(found.statistic), df, df_error, float(found.pvalue), float(share))


def tukey(ratings: ArrayLike) -> list[Pair]:
    """Tukey's honestly significant differences, which belong to `one_way`."""
    from scipy import stats

    ratings = _complete(ratings)
    pairs = itertools.combinations(range(ratings.shape[1]), 2)
    if np.all(ratings == ratings[:1]):  # no spread to compare with
        different = lambda first, second: float(ratings[0, first] == ratings[0, second])
        return [Pair(*pair, _difference(ratings, *pair), different(*pair)) for pair in pairs]
    p = stats.tukey_hsd(*ratings.T).pvalue
    return [Pair(*pair, _difference(ratings, *pair), float(p[pair])) for pair in pairs]


def repeated_measures(ratings: ArrayLike) -> RepeatedMeasures:
    """The main test: every rater is compared with themselves, F = MS_agents / MS_(agents x raters).

    epsilon = (tr S)^2 / ((agents - 1) tr S^2), with S the agents' covariance after taking out rows' and columns' means
    (Greenhouse and Geisser 1959); both degrees of freedom are multiplied by it.
    """
    from scipy import stats

    ratings = _complete(ratings)
    raters, agents = ratings.shape
    df, df_error = agents - 1, (agents - 1) * (raters - 1)
    f, share, epsilon = (float(value) for value in repeated_measures_of(ratings))
    if np.isnan(epsilon):
        between = raters * np.sum((ratings.mean(0) - ratings.mean()) ** 2)
        anova = _without_error(between, df, df_error)
        return RepeatedMeasures(anova, 1.0, anova.p)
    anova = Anova(f, df, df_error, float(stats.f.sf(f, df, df_error)), share)
    return RepeatedMeasures(anova, epsilon, float(stats.f.sf(f, epsilon * df, epsilon * df_error)))


def repeated_measures_of(ratings: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """F, partial eta squared and epsilon of many studies at once, from (..., raters, agents); nan where nobody differs."""
    raters, agents = ratings.shape[-2:]
    mean = ratings.mean((-2, -1), keepdims=True)
    of_agents = ratings.mean(-2, keepdims=True)
    rest = ratings - of_agents - ratings.mean(-1, keepdims=True) + mean
    between = raters * np.sum((of_agents - mean) ** 2, (-2, -1))
    error = np.sum(rest**2, (-2, -1))
    covariance = np.swapaxes(rest, -2, -1) @ rest
    spread = np.sum(covariance**2, (-2, -1))
    nothing = error <= 1e-12 * np.maximum(np.sum((ratings - mean) ** 2, (-2, -1)), 1e-12)
    with np.errstate(divide="ignore", invalid="ignore"):
        f = np.where(nothing, np.nan, between / error * (raters - 1))
        share = np.where(nothing, np.nan, between / (between + error))
        trace = np.trace(covariance, axis1=-2, axis2=-1)
        epsilon = np.where(nothing, np.nan, trace**2 / ((agents - 1) * spread))
    return f, share, epsilon


def friedman(ratings: ArrayLike) -> Friedman:
    """Friedman's test of three agents or more."""
    from scipy import stats

    ratings = _complete(ratings)
    raters, agents = ratings.shape
    if agents < 3:
        raise ValueError(f"ratings of {agents} agents: Friedman's test needs 3 or more")
    if np.all(ratings == ratings[:, :1]):  # everybody rates all agents alike
        return Friedman(0.0, agents - 1, 1.0, 0.0)
    found = stats.friedmanchisquare(*ratings.T)
    chi_squared = float(found.statistic)
    return Friedman(chi_squared, agents - 1, float(found.pvalue), chi_squared / (raters * (agents - 1)))


def wilcoxon(ratings: ArrayLike) -> list[SignedRanks]:
    """Wilcoxon's signed-rank test of every two agents, with Holm's correction; raters who see no difference are left out."""
    from scipy import stats
    from statsmodels.stats.multitest import multipletests

    ratings = _complete(ratings)
    rows = []
    for first, second in itertools.combinations(range(ratings.shape[1]), 2):
        apart = ratings[:, first] - ratings[:, second]
        apart = apart[apart != 0]
        if not apart.size:
            rows.append((first, second, 0.0, 0.0, 1.0, 0.0))
            continue
        found = stats.wilcoxon(apart)
        ranks = stats.rankdata(np.abs(apart))
        biserial = np.sum(np.sign(apart) * ranks) / np.sum(ranks)
        difference = _difference(ratings, first, second)
        rows.append((first, second, difference, float(found.statistic), float(found.pvalue), float(biserial)))
    corrected = multipletests([row[4] for row in rows], method="holm")[1]
    return [SignedRanks(*row[:5], float(p), row[5]) for row, p in zip(rows, corrected, strict=True)]


def bootstrap(
    statistic: Callable[[np.ndarray], np.ndarray], ratings: ArrayLike, draws: int = DRAWS, seed: int = 0
) -> Estimate:
    """A statistic and its 95 % interval over raters, who are drawn anew with all that they said (percentiles).

    Args:
      statistic: of (..., raters, agents), one number for each study.
    """
    ratings = _complete(ratings)
    chosen = np.random.default_rng(seed).integers(len(ratings), size=(draws, len(ratings)))
    low, high = np.quantile(statistic(ratings[chosen]), [0.025, 0.975])
    return Estimate(float(statistic(ratings)), float(low), float(high))


def _without_error(between: float, df: int, df_error: int) -> Anova:
    """Where nothing but the agents makes ratings differ: either nothing does, or all of it is theirs."""
    differ = between > 0
    return Anova(np.inf if differ else 0.0, df, df_error, 0.0 if differ else 1.0, float(differ))


def _difference(ratings: np.ndarray, first: int, second: int) -> float:
    return float(ratings[:, first].mean() - ratings[:, second].mean())


def _complete(ratings: ArrayLike) -> np.ndarray:
    """(raters, agents) as numbers. Raises ValueError, in one line, if they can't be compared."""
    ratings = np.asarray(ratings, np.float64)
    if ratings.ndim != 2 or min(ratings.shape) < 2:
        raise ValueError(f"ratings have shape {ratings.shape}: give (raters, agents), two of each or more")
    if not np.all(np.isfinite(ratings)):
        raise ValueError("ratings hold nan or inf: leave out raters who haven't rated every agent")
    return ratings


# --- do people agree? -----------------------------------------------------------------------------------------------------


def krippendorff(values: ArrayLike, level: str) -> float:
    """Krippendorff's alpha of values (people, units), nan where a person said nothing: 1 at agreement, 0 at chance.

    alpha = 1 - D_o / D_e, the disagreement within units by that between any two values, each pair of values weighed by the
    squared difference of its level of measurement (Krippendorff 2011, "Computing Krippendorff's Alpha-Reliability").

    Args:
      level: of measurement, one of `LEVELS`.

    Returns:
      nan if no unit has two values, or all values are one.
    """
    if level not in LEVELS:
        raise ValueError(f"level {level!r} is unknown: choose one of {', '.join(LEVELS)}")
    values = np.asarray(values, np.float64)
    if values.ndim != 2:
        raise ValueError(f"values have shape {values.shape}: give (people, units)")
    paired = values[:, np.sum(np.isfinite(values), 0) >= 2]  # a unit with one value has nothing to agree with
    named = np.unique(paired[np.isfinite(paired)])
    counts = np.sum(paired[None] == named[:, None, None], 1).astype(float)  # (values, units)
    per_unit = counts.sum(0)
    coincidences = (counts / (per_unit - 1)) @ counts.T - np.diag((counts / (per_unit - 1)).sum(1))
    total = counts.sum(1)
    squared = _squared_difference(named, total, level)
    expected = total @ squared @ total
    if not expected > 0:
        return float("nan")
    return float(1 - (total.sum() - 1) * np.sum(coincidences * squared) / expected)


def _squared_difference(values: np.ndarray, total: np.ndarray, level: str) -> np.ndarray:
    """(values, values) how different two of `values`, which occur `total` times, count as."""
    first, second = values[:, None], values[None]
    if level == "nominal":
        return (first != second).astype(float)
    if level == "interval":
        return (first - second) ** 2
    if level == "ratio":
        both = first + second
        return ((first - second) / np.where(both == 0, 1.0, both)) ** 2
    rank = np.cumsum(total) - total / 2  # what lies between two values, and half of each
    return (rank[:, None] - rank[None]) ** 2


class IntraclassCorrelation(NamedTuple):
    """ICC(2,1) and ICC(2,k) of Shrout and Fleiss 1979: raters are a sample, and their level counts."""

    single: float  # of one rater
    mean: float  # of the mean over all raters
    f: float  # of units, against what is left after raters and units
    p: float


def intraclass_correlation(values: ArrayLike) -> IntraclassCorrelation:
    """How much of the variance of values (people, units), without gaps, lies between the units."""
    from scipy import stats

    values = _complete(values)
    people, units = values.shape
    mean, of_units, of_people = values.mean(), values.mean(0), values.mean(1)
    between = people * np.sum((of_units - mean) ** 2) / (units - 1)
    judges = units * np.sum((of_people - mean) ** 2) / (people - 1)
    rest = values - of_units[None] - of_people[:, None] + mean
    error = np.sum(rest**2) / ((units - 1) * (people - 1))
    single = between + (people - 1) * error + people * (judges - error) / units
    if single == 0:
        return IntraclassCorrelation(float("nan"), float("nan"), float("nan"), float("nan"))
    f = between / error if error > 0 else np.inf
    return IntraclassCorrelation(
        single=float((between - error) / single),
        mean=float((between - error) / (between + (judges - error) / units)),
        f=float(f),
        p=float(stats.f.sf(f, units - 1, (units - 1) * (people - 1))),
    )


# --- does a person answer with care? --------------------------------------------------------------------------------------


class Share(NamedTuple):
    """How often something was so."""

    number: int
    of: int
    share: float  # nan of nothing
    low: float  # Wilson's 95 % interval
    high: float


def share(happened: ArrayLike) -> Share:
    """Of `happened` (n,), True where it was so."""
    from scipy import stats

    happened = np.asarray(happened, bool)
    number, of = int(happened.sum()), happened.size
    if not of:
        return Share(0, 0, float("nan"), float("nan"), float("nan"))
    interval = stats.binomtest(number, of).proportion_ci(method="wilson")
    return Share(number, of, number / of, float(interval.low), float(interval.high))


def left_share(chosen_left: ArrayLike) -> tuple[Share, float]:
    """How often the left one was chosen, where a side was, and p of a fair coin: sides are swapped for half of the pairs."""
    from scipy import stats

    found = share(chosen_left)
    return found, float(stats.binomtest(found.number, found.of).pvalue) if found.of else float("nan")


def consistency(first: ArrayLike, again: ArrayLike) -> Share:
    """How often a pair that was asked twice, with its sides swapped, was answered alike: P(first preferred) both times."""
    first, again = np.asarray(first, np.float64), np.asarray(again, np.float64)
    if first.shape != again.shape:
        raise ValueError(f"answers of shapes {first.shape} and {again.shape}: give each pair's first and second")
    return share(first == again)


class Conduct(NamedTuple):
    """What one person did that may exclude their data, never their payment."""

    consented: bool
    finished: bool
    checks_failed: int
    chosen_left: Sequence[bool]  # where a side was chosen
    reaction: Sequence[float]  # s, of every answer


class Limits(NamedTuple):
    """From when on a person's data are left out."""

    checks_failed: int = 1  # who ever prefers a collision fails the paper's sanity check
    one_side: float = 0.95  # share of answers on one side, of `ANSWERS_TO_JUDGE` or more
    fastest: float = 0.2  # s, median reaction below which nobody can have decided


ANSWERS_TO_JUDGE = 20  # before a person's sides and pace say anything


def exclusion(conduct: Conduct, limits: Limits, needs_all: bool) -> str | None:
    """Why a person's data are left out, in a few words; None if they count.

    Args:
      needs_all: whether a person who stopped early is left out, as among raters, who have to have seen every agent.
    """
    if not conduct.consented:
        return "no consent"
    if conduct.checks_failed >= limits.checks_failed:
        return f"{conduct.checks_failed} checks failed"
    if needs_all and not conduct.finished:
        return "not finished"
    sides = np.asarray(conduct.chosen_left, bool)
    if sides.size >= ANSWERS_TO_JUDGE and max(sides.mean(), 1 - sides.mean()) >= limits.one_side:
        return f"{max(sides.mean(), 1 - sides.mean()):.0%} on one side"
    reaction = np.asarray(conduct.reaction, float)
    if reaction.size >= ANSWERS_TO_JUDGE and np.median(reaction) < limits.fastest:
        return f"median reaction {np.median(reaction):.2f} s"
    return None
