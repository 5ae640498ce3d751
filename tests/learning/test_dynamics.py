"""T_A: the fitted Gaussians and their entropy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import Line, LineParams, Point, settings

from peps_jax import rollout
from peps_jax.config import Problem
from peps_jax.learning import dynamics
from peps_jax.trajectory import Transition

NUMBER = 2000
WIDTH = 0.1


@pytest.fixture(scope="module")
def config(line):
    return settings(
        line.replace(
            dynamics_updates=800, dynamics_learning_rate=5e-3, dynamics_batch_size=64, model_hidden_sizes=(16,),
            ensemble_size=2, params=LineParams(width=WIDTH),
        )
    ).dynamics  # fmt: skip


@jax.jit
def fitted(noise, config):
    """T_A of s' = s + 0.1 a + noise xi."""
    key_data, key_noise, key_init, key_fit = jax.random.split(jax.random.key(0), 4)
    observation, action = jax.random.uniform(key_data, (2, NUMBER, 1), minval=-1.0)
    after = observation + 0.1 * action + noise * jax.random.normal(key_noise, (NUMBER, 1))
    moved = (after - observation) / WIDTH
    replay = Transition(
        observation,
        action,
        jnp.zeros(NUMBER),
        after,
        moved,
        jnp.zeros(NUMBER, bool),
        jnp.zeros(NUMBER),
        jnp.zeros(NUMBER),
    )
    return dynamics.fit(dynamics.init(key_init, config), replay, NUMBER, key_fit, config)


def test_movement_is_in_units_of_the_perceptual_width(line):
    before, after = Point(jnp.array([0.2]), jnp.int32(0)), Point(jnp.array([0.25]), jnp.int32(1))
    moved = rollout.movement(before, after, line.problem())
    np.testing.assert_allclose(moved, [0.05 / WIDTH], rtol=1e-5)
    assert moved.dtype == jnp.float32


class Pair(Line):
    """A line on which people see the place in metres and in centimetres, each as well as the other."""

    def perceive(self, state):
        return jnp.concatenate([state.place, 100 * state.place])

    def perception_width(self, params):
        return jnp.array([1.0, 100.0]) * params.width


def test_every_perceived_number_moves_in_units_of_its_own(line):
    """Nothing that T_A predicts depends on the units, or on what the agent observes: its observation is one number here."""
    before, after = Point(jnp.array([0.2]), jnp.int32(0)), Point(jnp.array([0.25]), jnp.int32(1))
    for width in (0.1, 0.4):
        problem = Problem(Pair(), LineParams(width=width), LineParams(width=9.0))
        np.testing.assert_allclose(rollout.movement(before, after, problem), [0.05 / width] * 2, rtol=1e-5)
    config = line.replace(env=Pair(), params=LineParams(), belief=LineParams())
    assert settings(config).dynamics.perceived_size == 2


@pytest.mark.parametrize("noise", [0.0, 0.05, 0.2])
def test_fit_finds_mean_deviation_and_entropy(config, noise):
    state, info = fitted(noise, config)
    observation = jnp.linspace(-0.8, 0.8, 9)[:, None]
    action = jnp.linspace(0.9, -0.9, 9)[:, None]
    member = jax.tree.map(lambda leaf: leaf[0], state.params)
    prediction = dynamics.predict(member, observation, action, config)
    np.testing.assert_allclose(prediction.mean, 0.1 * action / WIDTH, atol=0.1 + noise / WIDTH * 0.25)
    if noise:
        np.testing.assert_allclose(jnp.exp(prediction.log_sd), noise / WIDTH, rtol=0.2)
    entropy = dynamics.environment_entropy(state, observation, action, config)
    assert entropy.shape == (9,)
    np.testing.assert_allclose(entropy, 0.5 * np.log1p((noise / WIDTH) ** 2), atol=0.01, rtol=0.25)
    assert np.isfinite(float(info["dynamics_loss"]))


def test_loss_is_the_negative_log_likelihood(config):
    state = dynamics.init(jax.random.key(0), config)
    member = jax.tree.map(lambda leaf: leaf[0], state.params)
    observation, action, after = jnp.array([[0.1], [0.3]]), jnp.array([[0.5], [-1.0]]), jnp.array([[0.2], [0.1]])
    moved = (after - observation) / WIDTH
    batch = Transition(observation, action, jnp.zeros(2), after, moved, jnp.zeros(2, bool), jnp.zeros(2), jnp.zeros(2))
    prediction = dynamics.predict(member, observation, action, config)
    sd = jnp.exp(prediction.log_sd)
    density = -0.5 * ((moved - prediction.mean) / sd) ** 2 - prediction.log_sd - 0.5 * np.log(2 * np.pi)
    np.testing.assert_allclose(dynamics.loss(member, batch, config), -jnp.mean(density), rtol=1e-5)


def test_standard_deviation_stays_within_its_bounds():
    low = dynamics._prediction(jnp.array([0.0, -1e3])).log_sd
    high = dynamics._prediction(jnp.array([0.0, 1e3])).log_sd
    np.testing.assert_allclose(low, dynamics.MIN_LOG_SD, atol=1e-3)
    assert dynamics.MAX_LOG_SD - 1e-3 <= float(high[0]) <= dynamics.MAX_LOG_SD + 1e-2
    assert 0.5 * np.log1p(np.exp(2 * dynamics.MIN_LOG_SD)) < 2e-4


def test_disagreement_of_members_is_no_entropy(config):
    """Members that predict different means with tiny deviations: ignorance, not the domain's randomness."""
    state = dynamics.init(jax.random.key(0), config)
    params = jax.tree.map(jnp.zeros_like, state.params)
    bias = jnp.array([[5.0, -50.0], [-5.0, -50.0]])
    params["params"]["Dense_1"]["bias"] = bias
    entropy = dynamics.environment_entropy(state.replace(params=params), jnp.zeros((1, 1)), jnp.zeros((1, 1)), config)
    np.testing.assert_allclose(entropy, 0.0, atol=1e-3)
