"""How many raters a study needs: against the power that is known in closed form, and at its ends."""

import numpy as np
import pytest
from scipy import stats

from peps_jax.human_study import power, statistics


def raters(effect, number=4_000, seed=0):
    """Two agents whose difference is normal with mean `effect` and standard deviation 1, at raters' own levels."""
    draw = np.random.default_rng(seed)
    level = draw.normal(5, 3, number)
    apart = draw.normal(effect, 1, number)
    return np.stack([level + apart / 2, level - apart / 2], 1)


@pytest.mark.parametrize(("effect", "number"), [(0.8, 10), (0.5, 30), (1.0, 5)])
def test_power_of_a_paired_test_in_closed_form(effect, number):
    found = power.power(raters(effect), number, studies=4_000)
    critical = stats.t.isf(0.025, number - 1)
    away = effect * np.sqrt(number)
    exact = stats.nct.sf(critical, number - 1, away) + stats.nct.cdf(-critical, number - 1, away)
    assert found.main.share == pytest.approx(exact, abs=0.03)


def test_without_a_difference_it_is_the_tests_error():
    nothing = raters(0.0, 20_000)
    nothing -= nothing.mean(0)
    assert power.power(nothing, 12, studies=4_000).main.share == pytest.approx(0.05, abs=0.015)


def test_each_study_has_the_p_of_the_tests():
    ratings = raters(0.7, 12, seed=1).round(1)
    draws = np.random.default_rng((0, 6)).integers(12, size=(50, 6))
    main = [statistics.repeated_measures(ratings[rows]).corrected_p < 0.05 for rows in draws]
    plain = [statistics.one_way(ratings[rows]).p < 0.05 for rows in draws]
    found = power.power(ratings, 6, studies=50)
    assert (found.main.number, found.one_way.number) == (sum(main), sum(plain))
    assert found.first_best.number <= found.main.number


def test_a_plan_goes_to_where_power_is_enough():
    planned = power.plan(raters(1.0, 400))
    enough = power.needed(planned)
    assert 8 <= enough <= 13, "a paired t test needs 10 for an effect of 1"
    assert planned[-1].raters == 2 * enough
    assert power.said(planned, "400 raters").startswith(f"{enough} raters find a difference (p < 0.05) with power 0.8")
    assert "60 raters" in power.said(power.plan(raters(0.01, 400)), "400 raters")
    assert power.needed(power.plan(raters(0.01, 400), most=5)) is None


def test_raters_who_all_agree_need_no_test():
    always = np.tile([[7.0, 5.0, 3.0]], (4, 1))
    assert power.power(always, 3).main.share == 1
    assert power.power(np.full((4, 3), 5.0), 3).main.share == 0


def test_ratings_that_are_too_few_are_refused():
    with pytest.raises(ValueError, match="two of each"):
        power.plan(np.zeros((1, 3)))
