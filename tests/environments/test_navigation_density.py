"""The density of the next position: against samples, against quadrature, and what holds of it everywhere."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from navigation_cases import (
    EVERYWHERE,
    MINDS,
    TASKS,
    actions,
    at,
    distribution,
    positions,
    property_of_all,
    relative_entropy,
    relative_log_prob,
    seeds,
    step,
)

from peps_envs.navigation import make_params


@property_of_all
@given(positions(), actions, st.tuples(st.floats(-3, 9, width=32), st.floats(-3, 9, width=32)).map(np.float32))
def test_relative_log_density_is_finite_and_never_positive(place, action, perceived):
    params, position = place
    value = relative_log_prob(position, action, perceived, params)
    assert np.isfinite(value)
    assert value <= 0


@property_of_all
@given(positions(st.sampled_from([TASKS[name].params for name in ("d1", "d2", "d4")])), actions, seeds)
def test_a_deterministic_prediction_scores_zero(place, action, seed):
    params, position = place
    after = step(seed, at(position), action, params)
    assert abs(relative_log_prob(position, action, after.state.position, params)) < 1e-5
    assert abs(relative_entropy(position, action, params)) < 1e-5


@property_of_all
@given(positions(), actions)
def test_environment_entropy_is_finite_and_never_negative(place, action):
    params, position = place
    value = relative_entropy(position, action, params)
    assert np.isfinite(value)
    assert value >= 0


# Sampling against density


TWO_WALLS = make_params(
    walls=((2.0, 0.0, 2.6, 2.5), (3.4, 2.9, 6.0, 3.3)), ice=EVERYWHERE, ice_noise=0.5, sand=(2.6, 0.0, 3.4, 6.0),
    sand_stuck=0.3, sand_gain=0.8,
)  # fmt: skip
PLACES = [  # mind, position, action
    (MINDS["d1", "biased"], (1.8, 1.0), (1.0, 0.3)),  # beside the pit
    (MINDS["d2", "biased"], (3.0, 0.2), (1.0, 0.0)),  # in the corridor, which the noise fills
    (MINDS["d3", "biased"], (3.0, 0.75), (1.0, 0.0)),  # on ice, between block and edge
    (MINDS["d3", "biased"], (1.6, 0.1), (-1.0, -1.0)),  # on ice, at the arena's edge
    (MINDS["d3", "biased"], (1.5, 1.5), (0.7, 0.7)),  # at the block's corner, where ice and sand meet
    (MINDS["d4", "both"], (4.5, 1.4), (0.3, 1.0)),  # past the other corner, on ice and beside the pit
    (MINDS["d3", "truth"], (0.75, 3.0), (0.0, 1.0)),  # on sand, stuck half of the time
    (MINDS["d3", "truth"], (1.45, 2.0), (1.0, 1.0)),  # on sand, against the block
    (MINDS["d4", "truth"], (1.45, 2.0), (1.0, 1.0)),  # deterministic, against the block
    (TWO_WALLS, (3.0, 2.7), (0.0, 0.0)),  # between two walls' corners, slipping and stuck
    (TWO_WALLS, (1.0, 5.8), (1.0, 1.0)),
]


@jax.jit
def sampled(key, position, action, params):
    """20 000 perceived and 20 000 true next positions."""
    expected = distribution(position, action, params)
    return jax.vmap(expected.sample)(jax.random.split(key, 20_000)), jax.vmap(expected.move)(
        jax.random.split(key, 20_000)
    )


@jax.jit
def density(position, action, params, points):
    return jnp.exp(jax.vmap(distribution(position, action, params).log_prob)(points))


@partial(jax.jit, static_argnums=3)
def quadrature(position, action, params, points):
    return distribution(position, action, params).quadrature(points)


SPACING, CELL = 0.05, 6  # arena units between points, a quarter of sigma_p; points along a cell's side
TICKS = np.arange(-1.2 + SPACING / 2, 7.2, SPACING, np.float32)  # five sigma_p beyond the arena
EDGES = np.linspace(-1.2, 7.2, len(TICKS) // CELL + 1)


@pytest.mark.parametrize(("params", "position", "action"), PLACES)
def test_samples_follow_the_density(params, position, action):
    position, action = jnp.array(position), jnp.array(action)
    points = np.stack(np.meshgrid(TICKS, TICKS, indexing="ij"), -1).reshape(-1, 2)
    mass = np.asarray(density(position, action, params, points), np.float64).reshape(len(TICKS), -1) * SPACING**2
    assert mass.sum() == pytest.approx(1, abs=1e-3)

    cells = len(TICKS) // CELL
    probability = mass.reshape(cells, CELL, cells, CELL).sum((1, 3))
    perceived, _ = sampled(jax.random.key(0), position, action, params)
    counts, _, _ = np.histogram2d(*np.asarray(perceived).T, bins=(EDGES, EDGES))
    assert counts.sum() == len(perceived)
    expected = probability * len(perceived)
    often = expected >= 10
    expected, counts = (np.append(cell[often], cell[~often].sum()) for cell in (expected, counts))
    chi_square = np.sum((counts - expected) ** 2 / np.maximum(expected, 1.0))
    assert chi_square < len(counts) + 5 * np.sqrt(2 * len(counts))


@pytest.mark.parametrize(("params", "position", "action"), PLACES)
def test_quadrature_has_the_samples_mean_and_variance(params, position, action):
    position, action = jnp.array(position), jnp.array(action)
    weights, places = quadrature(position, action, params, 120)
    assert weights.sum() == pytest.approx(1, abs=1e-5)
    mean = weights @ places
    variance = weights @ (places - mean[None]) ** 2
    _, moved = sampled(jax.random.key(1), position, action, params)
    # a clipped Gaussian is not a polynomial: some percent are all that even 120 nodes promise at a wall
    np.testing.assert_allclose(mean, np.mean(moved, 0), atol=0.03)
    np.testing.assert_allclose(variance, np.var(moved, 0), rtol=0.08, atol=1e-4)


def test_quadrature_is_exact_without_walls():
    pit = dict(pit=(3.0, 3.0, 3.1, 3.1), pit_noise=0.3, pit_range=1e3)
    params = make_params(sand=EVERYWHERE, sand_stuck=0.25, full_action=1.0, **pit)
    weights, places = quadrature(jnp.array([3.0, 3.0]), jnp.array([0.8, 0.0]), params, 5)
    mean = weights @ places
    np.testing.assert_allclose(mean, [3 + 0.75 * 0.6, 3.0], atol=1e-5)
    variance = weights @ (places - mean[None]) ** 2
    between = 0.25 * 0.75 * 0.6**2  # of being stuck or not
    np.testing.assert_allclose(variance, [0.75 * 0.3**2 + between, 0.75 * 0.3**2], rtol=1e-4)


@pytest.mark.parametrize("noise", [0.0, 0.1, 0.3])
def test_environment_entropy_of_pure_noise(noise):
    params = make_params(ice=EVERYWHERE, ice_noise=noise)
    expected = 2 * 0.5 * np.log1p((noise / 0.2) ** 2)
    assert relative_entropy(jnp.array([3.0, 3.0]), jnp.zeros(2), params) == pytest.approx(expected, rel=1e-4, abs=1e-6)


def test_a_belief_can_be_batched():
    belief = TASKS["d1"].beliefs["biased"]
    strengths = jnp.array([0.0, 0.5, 1.0])
    axes = jax.tree.map(lambda _: None, belief).replace(pit_noise=0)
    position, action, seen = jnp.array([1.8, 1.5]), jnp.array([0.0, 1.0]), jnp.array([1.8, 2.25])
    entropies = jax.vmap(relative_entropy, in_axes=(None, None, axes))(
        position, action, belief.replace(pit_noise=strengths)
    )
    scores = jax.vmap(relative_log_prob, in_axes=(None, None, None, axes))(
        position, action, seen, belief.replace(pit_noise=strengths)
    )
    for i, strength in enumerate(strengths):
        single = belief.replace(pit_noise=strength)
        np.testing.assert_allclose(entropies[i], relative_entropy(position, action, single), rtol=1e-5, atol=1e-6)
        np.testing.assert_allclose(scores[i], relative_log_prob(position, action, seen, single), rtol=1e-5, atol=1e-6)
    assert np.all(np.diff(entropies) > 0)
    assert np.all(np.diff(scores) < 0)  # what happened is less expected by those who expect more noise
