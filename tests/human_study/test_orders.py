"""In which order participants see what, and on which sides."""

import itertools
from collections import Counter

import pytest

from peps_jax.human_study import orders

CHECKS = range(5)


@pytest.mark.parametrize("seed", range(20))
@pytest.mark.parametrize(("total", "repeated", "checks"), [(200, 0.1, 5), (40, 0.1, 5), (20, 0.0, 0), (60, 0.25, 4)])
def test_half_of_the_pairs_are_swapped(seed, total, repeated, checks):
    order = orders.of_pairs(seed, total, repeated, 0.1, CHECKS[:checks])
    assert len(order) == total
    assert sum(place.swapped for place in order) == total // 2


@pytest.mark.parametrize("seed", range(20))
def test_a_repeat_comes_later_and_swapped(seed):
    order = orders.of_pairs(seed, 200, 0.1, 0.1, CHECKS)
    repeats = [(at, place) for at, place in enumerate(order) if place.kind == "repeat"]
    assert len(repeats) == 20
    assert len({place.repeats for _, place in repeats}) == 20
    for at, place in repeats:
        assert place.repeats + orders.GAP < at
        assert order[place.repeats].kind in ("ask", "shared")
        assert order[place.repeats].swapped != place.swapped


def test_every_check_comes_once_and_every_order_differs():
    orders_made = [orders.of_pairs(seed, 200, 0.1, 0.1, [7, 8, 9, 10, 11]) for seed in range(10)]
    for order in orders_made:
        assert sorted(place.number for place in order if place.kind == "check") == [7, 8, 9, 10, 11]
    assert len({tuple(order) for order in orders_made}) == 10
    assert orders_made[3] == orders.of_pairs(3, 200, 0.1, 0.1, [7, 8, 9, 10, 11])


def test_the_pool_is_as_large_as_participants_need():
    single, shared = orders.pool(15, 175, 0.1)
    kinds = Counter(place.kind for place in orders.of_pairs(0, 200, 0.1, 0.1, CHECKS))
    assert shared == pytest.approx(0.1 * (single + shared), abs=1)
    assert single + 3 * shared == pytest.approx(15 * 175, abs=3)
    assert 15 * kinds["shared"] == pytest.approx(3 * shared, abs=15)
    assert orders.pool(1, 20, 0.0) == (20, 0)


@pytest.mark.parametrize("number", [1, 2, 3, 4, 5, 6, 7])
def test_a_latin_square_is_balanced(number):
    square = orders.latin_square(number)
    each = len(square) // number
    for place in range(number):
        assert Counter(row[place] for row in square) == dict.fromkeys(range(number), each)
    followers = Counter(pair for row in square for pair in itertools.pairwise(row))
    assert len(followers) == number * (number - 1)
    assert set(followers.values()) <= {each}


def test_raters_see_every_agent_equally_often_at_every_place():
    scenes = {"peps": [1, 2, 3, 4], "sac": [5, 6, 7, 8], "drlhp": [9, 10, 11, 12], "policy_shaping": [13, 14, 15]}
    agent = {number: name for name, numbers in scenes.items() for number in numbers}
    seen = [[agent[place.number] for place in orders.of_scenes(rater, rater, scenes, 3, {})] for rater in range(8)]
    for row in seen:
        assert Counter(row) == dict.fromkeys(scenes, 3)
    for place in range(12):
        assert Counter(row[place] for row in seen) == dict.fromkeys(scenes, 2)


def test_scenes_that_were_shown_least_come_first():
    (first, *_) = orders.of_scenes(0, 0, {"peps": [1, 2, 3]}, 1, {1: 4, 2: 3, 3: 5})
    assert first.number == 2
