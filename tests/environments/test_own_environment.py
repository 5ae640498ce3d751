"""An environment of one's own, complete in a few lines: it trains, and it is evaluated."""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from conftest import TINY

import peps_jax
from peps_envs import Box, Environment, Step
from peps_jax import Config


class Track(NamedTuple):
    """What is true of a track, or believed of it."""

    pace: float  # length of a full step
    width: float = 0.1  # sigma_p: what people can tell apart


@dataclasses.dataclass(frozen=True)
class Walk(Environment):
    """A point walks along a line until it is at 1. Its state is (place, time)."""

    horizon: int = 20
    observation_size = 1
    action_space = Box(1)
    event_names = ("arrived",)

    def reset(self, key, params):
        return (jnp.zeros(1), jnp.int32(0)), jnp.zeros(1)

    def step(self, key, state, action, params):
        place, time = after = state[0] + params.pace * jnp.clip(action, -1, 1), state[1] + 1
        arrived = place[0] >= 1
        truncated = (time >= self.horizon) & ~arrived
        return Step(after, place, self.reward(state, action, after, params), arrived, truncated, arrived[None])

    def reward(self, state, action, next_state, params):
        return 10.0 * (next_state[0][0] >= 1) - 1.0

    def perceive(self, state):
        return state[0]

    def perception_width(self, params):
        return jnp.full(1, params.width)


def walk(**changes) -> Config:
    """Four rounds on the track, of which a human thinks that one is faster on it."""
    return Config(env=Walk(), params=Track(pace=0.2), belief=Track(pace=0.25), **(TINY | changes))


def test_it_trains_and_is_evaluated(train):
    config = walk()
    result = train(config)
    assert {"arrived", "surrogate_loss"} <= set(result.curves)
    for leaf in jax.tree.leaves((result.agents, result.knowledge)):
        if jnp.issubdtype(leaf.dtype, jnp.floating):
            assert np.all(np.isfinite(leaf))
    assert np.all(np.abs(result.act(jnp.zeros(1))) <= 1)
    evaluation = peps_jax.evaluate(result, 3)
    assert evaluation.perceived.shape == (3, 21, 1)
    # it knows itself: the truth is no surprise, and a belief surprises by (0.05 a / 0.1)^2 / 2 a step
    np.testing.assert_allclose(evaluation.log_true, 0.0, atol=1e-6)
    moves = np.diff(evaluation.perceived[..., 0]) / 0.2
    np.testing.assert_allclose(evaluation.log_belief, -np.sum((0.05 * moves / 0.1) ** 2 / 2, 1), rtol=1e-4)


def test_an_environment_owes_no_more_than_this():
    owed = {"reset", "step", "reward", "perceive", "perception_width"}
    assert Environment.__abstractmethods__ == owed


def test_it_needs_no_picture():
    assert Walk().scene((jnp.zeros(1), 0), Track(0.2)) is None
