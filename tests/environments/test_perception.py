"""Densities of the perceived next state against closed forms, and the one that every environment has by default."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats
from conftest import Line, LineParams
from test_own_environment import Track, Walk

import peps_envs
from peps_envs import Environment, Gaussian, Mixture

WIDTH = jnp.array([0.5, 2.0])
GAUSSIAN = Gaussian(mean=jnp.array([1.0, -1.0]), sd=jnp.array([0.0, 1.5]), width=WIDTH)
MIXTURE = Mixture(jnp.array([[0.0, 0.0], [1.0, 3.0], [9.0, 9.0]]), jnp.array([0.25, 0.75, 0.0]), WIDTH)
POINTS = np.random.default_rng(0).normal(size=(50, 2)).astype(np.float32) * 2


def kernel_at_zero():
    return scipy.stats.norm(0, WIDTH).logpdf(0).sum()


def expected_log_prob(density, point):
    if isinstance(density, Gaussian):
        return scipy.stats.norm(density.mean, np.hypot(density.sd, WIDTH)).logpdf(point).sum()
    each = [scipy.stats.norm(outcome, WIDTH).logpdf(point).sum() for outcome in density.outcomes]
    return np.log(np.exp(each) @ np.asarray(density.weights))


@pytest.mark.parametrize("density", [GAUSSIAN, MIXTURE], ids=["Gaussian", "Mixture"])
def test_log_densities_are_scipys(density):
    found, relative = (jax.vmap(score)(POINTS) for score in (density.log_prob, density.relative_log_prob))
    expected = np.array([expected_log_prob(density, point) for point in POINTS])
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(relative, expected - kernel_at_zero(), rtol=1e-4, atol=1e-4)
    assert np.all(relative <= 0)


@pytest.mark.parametrize("density", [GAUSSIAN, MIXTURE], ids=["Gaussian", "Mixture"])
def test_samples_have_the_densitys_mean_and_spread(density):
    seen = np.asarray(jax.vmap(density.sample)(jax.random.split(jax.random.key(0), 20_000)))
    if isinstance(density, Gaussian):
        mean, variance = density.mean, density.sd**2
    else:
        mean, variance = np.array([0.75, 2.25]), 0.25 * 0.75 * np.array([1.0, 9.0])
    np.testing.assert_allclose(seen.mean(0), mean, atol=0.06)
    np.testing.assert_allclose(seen.var(0), variance + WIDTH**2, rtol=0.04)
    entropy = 0.5 * np.sum(np.log1p(variance / WIDTH**2))
    np.testing.assert_allclose(density.relative_entropy(), entropy, rtol=1e-5)


def test_a_perfect_deterministic_prediction_scores_zero():
    outcome = jnp.array([3.0, 4.0])
    for density in (Gaussian(outcome, jnp.zeros(()), WIDTH), Mixture(outcome[None], jnp.ones(1), WIDTH)):
        assert density.relative_log_prob(outcome) == 0
        assert density.relative_entropy() == 0
        missed = outcome + 2 * WIDTH  # by two widths in both
        assert density.relative_log_prob(missed) == pytest.approx(-4, rel=1e-5)


# The default


def test_by_default_a_step_is_made_and_seen_through_the_kernel():
    state, seen = (jnp.array([0.3]), jnp.int32(0)), jnp.array([0.6])
    density = Walk().next_state_distribution(state, jnp.ones(1), Track(pace=0.2))
    assert density.relative_log_prob(seen) == pytest.approx(-0.5 * ((0.6 - 0.5) / 0.1) ** 2, rel=1e-4)
    assert density.relative_entropy() == 0


def test_by_default_highway_without_friction_limits_is_its_own_density():
    environment, params = peps_envs.highway.Highway(friction_points=1), peps_envs.highway.make_params()
    state, _ = environment.reset(jax.random.key(0), params)
    own = environment.next_state_distribution(state, jnp.int32(3), params)
    default = Environment.next_state_distribution(environment, state, jnp.int32(3), params)
    np.testing.assert_allclose(default.mean, own.outcomes[0], rtol=1e-6)
    seen = own.outcomes[0] + 1.0
    np.testing.assert_allclose(default.log_prob(seen), own.log_prob(seen), rtol=1e-5)


@dataclasses.dataclass(frozen=True)
class Drawn(Line):
    """The noisy line, with the default density."""

    random_draws: int = 400

    next_state_distribution = Environment.next_state_distribution


def test_an_environment_with_chance_in_its_steps_says_from_how_many_it_is_estimated():
    params = LineParams(noise=0.2)
    state, _ = Line().reset(jax.random.key(3), params)
    closed, drawn = (line.next_state_distribution(state, jnp.ones(1), params) for line in (Line(), Drawn()))
    np.testing.assert_allclose(drawn.relative_entropy(), closed.relative_entropy(), rtol=0.1)
    seen = closed.mean[None] + jnp.array([[-0.3], [0.0], [0.2]])
    found, expected = (jax.vmap(density.relative_log_prob)(seen) for density in (drawn, closed))
    np.testing.assert_allclose(found, expected, atol=0.15)
    # one draw would hold its own chance for certain
    assert Drawn(random_draws=1).next_state_distribution(state, jnp.ones(1), params).relative_entropy() == 0


def test_draws_are_the_same_at_every_state_and_under_all_parameters():
    params = LineParams(noise=0.2)
    state, _ = Line().reset(jax.random.key(3), params)
    moved = state.replace(place=state.place + 1)
    first, again, wider = (
        np.asarray(Drawn(random_draws=5).next_state_distribution(of, jnp.ones(1), belief).outcomes)
        for of, belief in ((state, params), (moved, params), (state, LineParams(noise=0.4)))
    )
    np.testing.assert_allclose(again - first, 1.0, rtol=1e-5)
    middle = np.asarray(state.place) + 0.1
    np.testing.assert_allclose(wider - middle, 2 * (first - middle), rtol=1e-4, atol=1e-6)
