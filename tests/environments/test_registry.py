"""Environments by name, and one and a belief of one's own among them."""

import pytest
from test_own_environment import Track, Walk

import peps_envs
from peps_envs import Task, registry
from peps_jax import Config


def track() -> Task:
    return Task(Walk(), Track(pace=0.2), {"faster": Track(pace=0.3), "true": Track(pace=0.2)})


@pytest.fixture
def registered(monkeypatch):
    """A registry with the track, put back afterwards."""
    monkeypatch.setattr(registry, "_TASKS", dict(registry._TASKS))
    peps_envs.register("track", track)


def test_the_names():
    assert peps_envs.names()[:6] == ("nav-d1", "nav-d2", "nav-d3", "nav-d4", "highway-dry", "highway-rain")
    for name in peps_envs.names():
        assert isinstance(peps_envs.make(name), Task)


@pytest.mark.parametrize(("wrong", "right"), [("nav-d5", "nav-d"), ("nav_d1", "nav-d1"), ("navd3", "nav-d3")])
def test_an_unknown_name_gives_the_nearest(wrong, right):
    with pytest.raises(
        ValueError, match=rf"^env '{wrong}' is unknown: did you mean '{right}.*'\? known are nav-d1, .*"
    ):
        peps_envs.make(wrong)


def test_a_name_like_no_other_gives_the_list():
    with pytest.raises(ValueError, match=rf"^env 'zzz' is unknown: known are {', '.join(peps_envs.names())}$"):
        peps_envs.make("zzz")


def test_an_unknown_belief_gives_the_nearest(registered):
    with pytest.raises(
        ValueError, match=r"^belief 'fastr' is unknown: did you mean 'faster'\? known are faster, true$"
    ):
        Config(env="track", belief="fastr")


def test_a_taken_name_is_refused(registered):
    for name in ("nav-d1", "track"):
        with pytest.raises(ValueError, match=f"^env '{name}' is registered already"):
            peps_envs.register(name, track)


def test_a_task_of_ones_own_is_found(registered):
    assert peps_envs.names()[-1] == "track"
    problem = Config(env="track").problem()
    assert (problem.environment, problem.params.pace, problem.belief.pace) == (Walk(), 0.2, 0.3)
    assert Config(env="track", belief="true").problem().belief.pace == 0.2
    assert Config(env="track", belief=Track(pace=0.7)).problem().belief.pace == 0.7


def test_an_environment_object_needs_its_parameters():
    with pytest.raises(ValueError, match=r"^params is None: give it when env is an Environment object$"):
        Config(env=Walk()).problem()
    assert Config(env=Walk(), params=Track(0.2), belief=Track(0.3)).problem().params == Track(0.2)
