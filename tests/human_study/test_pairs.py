"""Which pairs people see."""

import json

import jax
import numpy as np
import pytest

from peps_jax.human_study import pairs
from peps_jax.human_study.database.records import Stimulus
from peps_jax.reproduce.driving.scenes import crashed


@pytest.fixture(scope="module")
def routes():
    return pairs.to_ask("nav-d4", 0, 60)


@pytest.fixture(scope="module")
def drives():
    return pairs.to_ask("highway-dry", 0, 40)


def test_routes_start_alike_and_part(routes):
    assert routes.mask.shape == (60, 2, pairs.LONGEST)
    assert np.min(np.sum(routes.mask, -1)) >= pairs.SHORTEST
    first, second = np.swapaxes(routes.state.position[:, :, 0], 0, 1)
    assert np.array_equal(first, second)
    assert np.mean(np.any(routes.action[:, 0, 0] != routes.action[:, 1, 0], -1)) > 0.9


def test_some_routes_take_the_ice_and_some_the_sand_and_some_arrive(routes):
    task = pairs.problem("nav-d4")
    on = lambda area: np.any(_inside(routes.next_state.position, area) & routes.mask, -1)
    assert np.mean(on(task.params.ice)) > 0.1
    assert np.mean(on(task.params.sand)) > 0.1
    assert np.any(on(task.params.goal))


def _inside(position, area):
    x0, y0, x1, y1 = np.asarray(area).reshape(-1)[:4]
    x, y = position[..., 0], position[..., 1]
    return (x >= x0) & (x <= x1) & (y >= y0) & (y <= y1)


def test_pieces_of_half_of_the_routes_are_equally_long(routes):
    alone = routes.mask[:, :, -1] | (np.sum(routes.mask, -1) > 0)
    assert np.all(alone)
    first, second = np.sum(routes.mask, -1).T
    assert np.mean(first == second) > 0.2


def test_nobody_crashes_on_the_road(drives):
    assert drives.mask.shape[:2] == (40, 2)
    assert not np.any(crashed(drives))
    first, second = (drives.state.vehicles.x[:, side, 0] for side in range(2))
    assert np.mean(np.all(first == second, -1)) > 0.7  # of those that begin with the scene


def test_a_check_is_braking_and_a_collision():
    made = pairs.to_check("highway-dry", 0, 5)
    first, second = np.asarray(crashed(made)).T
    assert not np.any(first)
    assert np.all(second)
    assert pairs.to_check("nav-d4", 0, 5) is None
    assert pairs.to_check("highway-rain", 0, 5) is None


def test_pairs_come_back_as_they_were_kept(routes):
    task, some = pairs.problem("nav-d4"), jax.tree.map(lambda rows: rows[:3], routes)
    kept = pairs.pairs_of(task, some)
    assert len({one.digest for one in kept}) == 3
    back = pairs.segments_of(task, kept)
    assert jax.tree.structure(back) == jax.tree.structure(some)
    for found, right in zip(jax.tree.leaves(back), jax.tree.leaves(some), strict=True):
        assert found.dtype == right.dtype
        assert np.array_equal(found, right)
    for one in kept:
        assert all(map(json.loads, one.drawings))
        assert sum(map(len, one.drawings)) < 2000


def test_scenes_come_back_too(routes):
    task, some = pairs.problem("nav-d4"), jax.tree.map(lambda rows: rows[:2, 0], routes)
    kept = pairs.scenes_of(task, some)
    assert [len(one.drawings) for one in kept] == [1, 1]
    assert np.array_equal(pairs.segments_of(task, kept).mask, some.mask)


def test_arrays_that_changed_are_refused(routes):
    task = pairs.problem("nav-d4")
    one, other = pairs.pairs_of(task, jax.tree.map(lambda rows: rows[:2], routes))
    with pytest.raises(ValueError, match="have changed since"):
        pairs.segments_of(task, [Stimulus(one.digest, other.arrays, one.drawings)])


def test_the_same_seed_makes_the_same_pairs(routes):
    again = pairs.to_ask("nav-d4", 0, 60)
    other = pairs.to_ask("nav-d4", 1, 60)
    assert np.array_equal(again.action, routes.action)
    assert not np.array_equal(other.action, routes.action)


@pytest.mark.long
def test_people_compare_physics_too():
    task = pairs.problem("mjx-box")
    asked = pairs.to_ask("mjx-box", 0, 3)
    shown = pairs.pairs_of(task, asked)
    agents = [[shape for shape in json.loads(drawing)["shapes"] if isinstance(shape, dict) and shape["colour"] == "agent"]
              for one in shown for drawing in one.drawings]  # fmt: skip
    assert [len(found) for found in agents] == [1] * 6
    again = pairs.segments_of(task, shown)
    assert jax.tree.all(jax.tree.map(np.array_equal, again, asked._replace(worth=None)))
