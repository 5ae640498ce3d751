"""Statistics of a human study: against scipy, statsmodels, published examples, and what can be worked out by hand."""

import itertools

import numpy as np
import pytest
from scipy import stats

from peps_jax.human_study import statistics
from peps_jax.human_study.statistics import Conduct, Limits

NONE = np.nan
# Krippendorff 2011, "Computing Krippendorff's Alpha-Reliability", part C: four observers, twelve units, some values missing
OBSERVERS = np.array(
    [
        [1, 2, 3, 3, 2, 1, 4, 1, 2, NONE, NONE, NONE],
        [1, 2, 3, 3, 2, 2, 4, 1, 2, 5, NONE, 3],
        [NONE, 3, 3, 3, 2, 3, 4, 2, 2, 5, 1, NONE],
        [1, 2, 3, 3, 2, 4, 4, 1, 2, 5, 1, NONE],
    ]
)
# Shrout and Fleiss 1979, table 2: six targets, four judges
JUDGES = np.array([[9, 6, 8, 7, 10, 6], [2, 1, 4, 1, 5, 2], [5, 3, 6, 2, 6, 4], [8, 2, 8, 6, 9, 7]], float)


@pytest.fixture(scope="module")
def ratings():
    """(15, 3) of raters who have levels of their own, and of agents who differ."""
    draw = np.random.default_rng(3)
    felt = draw.normal(5, 1.5, (15, 1)) + np.array([1.5, -0.5, 0.0]) + draw.normal(0, [0.8, 1.2, 1.8], (15, 3))
    return np.clip(np.round(felt, 1), 1, 10)


def test_one_way_anova_and_tukey_are_scipys(ratings):
    found = statistics.one_way(ratings)
    reference = stats.f_oneway(*ratings.T)
    assert (found.f, found.p) == pytest.approx((reference.statistic, reference.pvalue), rel=1e-6)
    assert (found.df, found.df_error) == (2, 42)
    p = stats.tukey_hsd(*ratings.T).pvalue
    assert [(pair.first, pair.second) for pair in statistics.tukey(ratings)] == [(0, 1), (0, 2), (1, 2)]
    for pair in statistics.tukey(ratings):
        assert pair.p == pytest.approx(p[pair.first, pair.second], rel=1e-6)
        assert pair.difference == pytest.approx(np.mean(ratings[:, pair.first] - ratings[:, pair.second]))


def test_one_way_anova_by_hand():
    # between: 3 * (3^2 + 0 + 3^2) = 54 on 2 degrees of freedom; within: 6 on 6; F = 27
    found = statistics.one_way([[8, 5, 2], [9, 6, 3], [10, 7, 4]])
    assert found.f == pytest.approx(27)
    assert found.eta_squared == pytest.approx(54 / 60)
    assert found.p == pytest.approx((1 + 27 * 2 / 6) ** -3, rel=1e-6)


def test_repeated_measures_are_those_of_statsmodels(ratings):
    pandas = pytest.importorskip("pandas")
    from statsmodels.stats.anova import AnovaRM

    raters, agents = np.indices(ratings.shape).reshape(2, -1)
    long = pandas.DataFrame({"rater": raters, "agent": agents, "rating": ratings.ravel()})
    reference = AnovaRM(long, "rating", "rater", ["agent"]).fit().anova_table.iloc[0]
    found = statistics.repeated_measures(ratings).anova
    assert found.f == pytest.approx(reference["F Value"], rel=1e-6)
    assert found.p == pytest.approx(reference["Pr > F"], rel=1e-6)
    assert (found.df, found.df_error) == (reference["Num DF"], reference["Den DF"])
    assert found.eta_squared == pytest.approx(found.f * found.df / (found.f * found.df + found.df_error), rel=1e-9)


def test_the_correction_by_greenhouse_and_geisser(ratings):
    found = statistics.repeated_measures(ratings)
    # from the covariance matrix's own elements, as Box wrote it
    cov = np.cov(ratings.T)
    size = len(cov)
    above = size**2 * (np.trace(cov) / size - cov.mean()) ** 2
    below = (size - 1) * (np.sum(cov**2) - 2 * size * np.sum(cov.mean(1) ** 2) + size**2 * cov.mean() ** 2)
    assert found.epsilon == pytest.approx(above / below, rel=1e-9)
    assert 1 / (size - 1) <= found.epsilon <= 1
    assert found.corrected_p > found.anova.p
    assert found.corrected_p == pytest.approx(
        stats.f.sf(found.anova.f, 2 * found.epsilon, 28 * found.epsilon), rel=1e-6
    )
    two = statistics.repeated_measures(ratings[:, :2])
    assert two.epsilon == pytest.approx(1), "two agents have one difference"
    paired = stats.ttest_rel(ratings[:, 0], ratings[:, 1])
    assert two.anova.f == pytest.approx(paired.statistic**2, rel=1e-6)
    assert two.anova.p == pytest.approx(paired.pvalue, rel=1e-6)


def test_what_raters_differ_in_does_not_blur_repeated_measures(ratings):
    shifted = ratings + np.linspace(-20, 20, len(ratings))[:, None]
    assert statistics.repeated_measures(shifted).anova.f == pytest.approx(
        statistics.repeated_measures(ratings).anova.f, rel=1e-9
    )
    assert statistics.one_way(shifted).f < statistics.one_way(ratings).f


def test_friedman_is_scipys(ratings):
    found = statistics.friedman(ratings)
    reference = stats.friedmanchisquare(*ratings.T)
    assert (found.chi_squared, found.p) == pytest.approx((reference.statistic, reference.pvalue), rel=1e-6)
    one_order = statistics.friedman(np.array([[1, 2, 3]] * 5))
    assert one_order.concordance == pytest.approx(1)
    with pytest.raises(ValueError, match="2 agents"):
        statistics.friedman(ratings[:, :2])


def test_wilcoxon_is_scipys_and_holm_is_by_hand(ratings):
    found = statistics.wilcoxon(ratings)
    for pair in found:
        apart = ratings[:, pair.first] - ratings[:, pair.second]
        reference = stats.wilcoxon(apart[apart != 0])
        assert (pair.statistic, pair.p) == pytest.approx((reference.statistic, reference.pvalue), rel=1e-6)
    p = np.array([pair.p for pair in found])
    stepped = np.maximum.accumulate(np.sort(p) * np.arange(len(p), 0, -1)).clip(max=1)
    assert [pair.corrected_p for pair in found] == pytest.approx(stepped[np.argsort(np.argsort(p))], rel=1e-9)
    (always,) = statistics.wilcoxon(np.array([[2.0, 1], [3, 1], [5, 2]]))
    assert always.rank_biserial == 1


@pytest.mark.parametrize("equal", [np.full((4, 3), 5.0), np.tile([[1.0, 2, 3]], (4, 1))])
def test_ratings_without_spread_give_no_warning(equal):
    differ = bool(np.ptp(equal[0]))
    for p in (statistics.one_way(equal).p, statistics.repeated_measures(equal).corrected_p):
        assert p == (0 if differ else 1)
    assert statistics.friedman(equal).p < 0.05 or not differ
    assert [pair.p for pair in statistics.tukey(equal)] == [0.0 if differ else 1.0] * 3
    assert all(np.isfinite(pair.corrected_p) for pair in statistics.wilcoxon(equal))


def test_a_bootstrap_draws_raters_with_all_that_they_said(ratings):
    difference = lambda rated: (rated[..., 0] - rated[..., 1]).mean(-1)
    found = statistics.bootstrap(difference, ratings, draws=2_000)
    reference = stats.bootstrap(
        (ratings[:, 0] - ratings[:, 1],), np.mean, method="percentile", n_resamples=2_000, rng=np.random.default_rng(0)
    ).confidence_interval
    assert found.value == pytest.approx(difference(ratings))
    assert (found.low, found.high) == pytest.approx(tuple(reference), abs=0.1)
    level = statistics.bootstrap(difference, ratings + np.linspace(-90, 90, 15)[:, None], draws=2_000)
    assert level == pytest.approx(found), "a rater's own level cancels"


@pytest.mark.parametrize("wrong", [np.zeros(3), np.zeros((1, 3)), np.array([[1.0, 2], [3, np.nan]])])
def test_ratings_that_cant_be_compared_are_refused(wrong):
    with pytest.raises(ValueError, match="ratings h"):
        statistics.repeated_measures(wrong)


# --- agreement --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("level", "published"), [("nominal", 0.743), ("ordinal", 0.815), ("interval", 0.849), ("ratio", 0.797)]
)
def test_krippendorffs_own_example(level, published):
    assert statistics.krippendorff(OBSERVERS, level) == pytest.approx(published, abs=5e-4)


def test_krippendorffs_alpha_to_the_last_digit():
    # his coincidence matrix: 7, 10, 8, 4 and 3 agreements, 9, 13, 10, 5 and 3 values of each kind, 40 in all
    totals = np.array([9, 13, 10, 5, 3])
    by_chance = np.sum(totals * (totals - 1))
    assert statistics.krippendorff(OBSERVERS, "nominal") == pytest.approx(
        (39 * (7 + 10 + 8 + 4 + 3) - by_chance) / (40 * 39 - by_chance), abs=1e-9
    )


def from_pairs(values, squared):
    """Alpha from its definition, pair by pair."""
    units = [column[np.isfinite(column)] for column in values.T]
    units = [unit for unit in units if len(unit) > 1]
    together = np.concatenate(units)
    observed = sum(
        sum(squared(a, b) for a, b in itertools.permutations(unit, 2)) / (len(unit) - 1) for unit in units
    ) / len(together)
    expected = sum(squared(a, b) for a, b in itertools.permutations(together, 2))
    return 1 - observed / (expected / (len(together) * (len(together) - 1)))


def test_krippendorffs_alpha_pair_by_pair():
    draw = np.random.default_rng(0)
    values = np.clip(draw.integers(1, 8, 30) + draw.integers(-1, 2, (4, 30)), 1, 9).astype(float)
    values[draw.random(values.shape) < 0.3] = np.nan
    there = values[:, np.isfinite(values).sum(0) > 1]
    there = there[np.isfinite(there)]

    def ordinal(a, b):
        low, high = min(a, b), max(a, b)
        return (np.sum((there >= low) & (there <= high)) - (np.sum(there == a) + np.sum(there == b)) / 2) ** 2

    ways = {
        "nominal": lambda a, b: float(a != b),
        "ordinal": ordinal,
        "interval": lambda a, b: (a - b) ** 2,
        "ratio": lambda a, b: ((a - b) / (a + b)) ** 2,
    }
    for level, squared in ways.items():
        assert statistics.krippendorff(values, level) == pytest.approx(from_pairs(values, squared), abs=1e-9)


def test_krippendorffs_alpha_at_its_ends():
    alike = np.tile(np.array([[1.0, 2, 3, 4]]), (3, 1))
    assert all(statistics.krippendorff(alike, level) == pytest.approx(1) for level in statistics.LEVELS)
    noise = np.random.default_rng(1).integers(0, 2, (3, 4_000)).astype(float)
    assert statistics.krippendorff(noise, "nominal") == pytest.approx(0, abs=0.03)
    assert np.isnan(statistics.krippendorff(np.full((2, 3), 5.0), "nominal")), "nothing to tell apart"
    assert np.isnan(statistics.krippendorff(np.array([[1.0, NONE], [NONE, 2]]), "ordinal")), "no unit seen twice"
    with pytest.raises(ValueError, match="'cardinal' is unknown: choose one of nominal"):
        statistics.krippendorff(alike, "cardinal")


def test_shrouts_and_fleisss_own_example():
    found = statistics.intraclass_correlation(JUDGES)
    assert (found.single, found.mean) == pytest.approx((0.29, 0.62), abs=5e-3)
    # their table 3: mean squares of 11.24 between targets, 32.49 between judges, 1.02 left, of 4 judges and 6 targets
    assert found.f == pytest.approx(11.24 / 1.02, rel=5e-3)
    assert found.single == pytest.approx(
        (11.2417 - 1.0194) / (11.2417 + 3 * 1.0194 + 4 * (32.4861 - 1.0194) / 6), rel=1e-4
    )
    alike = statistics.intraclass_correlation(np.tile(np.array([[1.0, 2, 3]]), (4, 1)))
    assert (alike.single, alike.mean, alike.p) == (1, 1, 0)
    assert np.isnan(statistics.intraclass_correlation(np.full((3, 3), 5.0)).single)


# --- care ---------------------------------------------------------------------------------------------------------------------


def test_shares_have_wilsons_interval():
    found = statistics.share([True] * 8 + [False] * 2)
    z = stats.norm.ppf(0.975)
    middle, half = (0.8 + z**2 / 20) / (1 + z**2 / 10), z / (1 + z**2 / 10) * np.sqrt(0.8 * 0.2 / 10 + z**2 / 400)
    assert (found.low, found.high) == pytest.approx((middle - half, middle + half), rel=1e-6)
    assert np.isnan(statistics.share([]).share)


def test_sides_and_repeats():
    found, p = statistics.left_share([True] * 15 + [False] * 5)
    assert found.share == 0.75
    assert p == pytest.approx(stats.binomtest(15, 20).pvalue, rel=1e-9)
    assert np.isnan(statistics.left_share([])[1])
    assert statistics.consistency([1, 0, 0.5, 1], [1, 1, 0.5, 0.5]).share == 0.5
    with pytest.raises(ValueError, match="first and second"):
        statistics.consistency([1, 0], [1])


CAREFUL = Conduct(consented=True, finished=True, checks_failed=0, chosen_left=[True, False] * 20, reaction=[2.0] * 40)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({}, None),
        ({"consented": False}, "no consent"),
        ({"checks_failed": 2}, "2 checks failed"),
        ({"finished": False}, "not finished"),
        ({"chosen_left": [True] * 40}, "100% on one side"),
        ({"chosen_left": [False] * 10}, None),
        ({"reaction": [0.05] * 40}, "median reaction 0.05 s"),
    ],
)
def test_who_is_left_out_and_why(change, reason):
    assert statistics.exclusion(CAREFUL._replace(**change), Limits(), needs_all=True) == reason


def test_a_trainer_who_stopped_early_counts():
    assert statistics.exclusion(CAREFUL._replace(finished=False), Limits(), needs_all=False) is None
