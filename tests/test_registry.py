"""Worlds by name, and a world and a belief of one's own."""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import peps_envs
from peps_envs import Box, Environment, NextState, Step, Task, registry
from peps_jax import Config


class Rail(NamedTuple):
    """A domain, or a belief about one."""

    speed: float
    width: float = 0.1  # sigma_p


class Blurred(NamedTuple):
    """A certain prediction, seen through the perceptual kernel."""

    place: jax.Array
    width: jax.Array


class RailNextState(Blurred, NextState):
    def relative_log_prob(self, perceived):
        return -0.5 * jnp.sum(((perceived - self.place) / self.width) ** 2)

    def log_prob(self, perceived):
        return self.relative_log_prob(perceived) - 0.5 * jnp.sum(jnp.log(2 * jnp.pi * self.width**2))

    def relative_entropy(self):
        return jnp.zeros(())

    def sample(self, key):
        return self.place + self.width * jax.random.normal(key, (1,))

    def quadrature(self, points):
        return jnp.ones(1), self.place[None]


@dataclasses.dataclass(frozen=True)
class Railway(Environment):
    """A point on a line that is done at 1; the state is (place, time)."""

    horizon: int = 20
    observation_size = 1
    action_space = Box(1)
    event_names = ("arrived",)

    def reset(self, key, params):
        return (jnp.zeros(1), jnp.zeros((), jnp.int32)), jnp.zeros(1)

    def step(self, key, state, action, params):
        place = self.next_state_distribution(state, action, params).place
        after, arrived = (place, state[1] + 1), place[0] >= 1
        truncated = (after[1] >= self.horizon) & ~arrived
        return Step(after, place, self.reward(state, action, after, params), arrived, truncated, arrived[None])

    def reward(self, state, action, next_state, params):
        return 10.0 * (next_state[0][0] >= 1) - 1.0

    def next_state_distribution(self, state, action, params):
        return RailNextState(state[0] + params.speed * jnp.clip(action, -1, 1), jnp.broadcast_to(params.width, (1,)))

    def perceive(self, state):
        return state[0]

    def perceive_observation(self, observation, params):
        return observation

    def perception_width(self, params):
        return jnp.broadcast_to(params.width, (1,))


def railway() -> Task:
    return Task(Railway(), Rail(speed=0.2), {"faster": Rail(speed=0.3), "true": Rail(speed=0.2)})


@pytest.fixture
def registered(monkeypatch):
    """A registry with the railway, put back afterwards."""
    monkeypatch.setattr(registry, "_TASKS", dict(registry._TASKS))
    peps_envs.register("railway", railway)


def test_the_names():
    assert peps_envs.names() == ("nav-d1", "nav-d2", "nav-d3", "nav-d4", "highway-dry", "highway-rain")
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
        Config(env="railway", belief="fastr")


def test_a_taken_name_is_refused(registered):
    for name in ("nav-d1", "railway"):
        with pytest.raises(ValueError, match=f"^env '{name}' is registered already"):
            peps_envs.register(name, railway)


def test_a_task_of_ones_own_is_found(registered):
    assert peps_envs.names()[-1] == "railway"
    environment, params, belief = Config(env="railway").task()
    assert (environment, params.speed, belief.speed) == (Railway(), 0.2, 0.3)
    assert Config(env="railway", belief="true").task()[2].speed == 0.2
    assert Config(env="railway", belief=Rail(speed=0.7)).task()[2].speed == 0.7


@pytest.mark.slow
def test_a_task_of_ones_own_trains(registered, tiny, train):
    result = train(tiny.replace(env="railway", belief=Rail(speed=0.4)))
    assert result.curves["return_"].shape == (tiny.num_rounds,)
    assert {"arrived", "surrogate_loss"} <= set(result.curves)
    for leaf in jax.tree.leaves((result.agents, result.knowledge)):
        if jnp.issubdtype(leaf.dtype, jnp.floating):
            assert np.all(np.isfinite(leaf))
    action = result.act(jnp.zeros(1))
    assert action.shape == (1,)
    assert np.all(np.abs(action) <= 1)


def test_an_environment_object_needs_its_parameters():
    with pytest.raises(ValueError, match=r"^params is None: give it when env is an Environment object$"):
        Config(env=Railway()).task()
    assert Config(env=Railway(), params=Rail(0.2), belief=Rail(0.3)).task()[1] == Rail(0.2)
