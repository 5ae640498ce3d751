"""The density of what people see next on the road: a mixture over what the tyres may hold."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from highway_cases import ROAD, TASKS, plans, property_of_all, reset, seeds, step
from hypothesis import given
from hypothesis import strategies as st

from peps_envs import highway
from peps_envs.highway import environment
from peps_envs.highway.vehicle import IDLE, LANE_LEFT, SLOWER


@jax.jit
def distribution(state, action, params):
    return ROAD.next_state_distribution(state, action, params)


@jax.jit
def sampled(key, state, action, params):
    """20 000 perceived next states of the simulation, and as many of the distribution."""
    keys, keys_see = jax.random.split(key, (2, 20_000))
    moved = jax.vmap(lambda key: ROAD.perceive(ROAD.step(key, state, action, params).state))(keys)
    expected = ROAD.next_state_distribution(state, action, params)
    seen = moved + params.perception_width[None] * jax.vmap(lambda key: jax.random.normal(key, (3,)))(keys_see)
    return moved, seen, jax.vmap(expected.sample)(keys)


@jax.jit
def log_probs(state, action, params, perceived):
    return jax.vmap(ROAD.next_state_distribution(state, action, params).log_prob)(perceived)


def after(name, *plan):
    """The state of one episode after the actions of `plan`."""
    params = TASKS[name].params
    state, _ = reset(jax.random.key(3), params)
    for action in plan:
        state = step(jax.random.key(7), state, jnp.int32(action), params).state
    return state


PLACES = [
    ("rain", (), LANE_LEFT),
    ("rain", (IDLE,), SLOWER),
    ("rain", (IDLE, SLOWER), LANE_LEFT),
    ("dry", (IDLE,), SLOWER),
]


@pytest.mark.parametrize(("name", "plan", "action"), PLACES)
def test_steps_follow_the_distribution(name, plan, action):
    params, state = TASKS[name].params, after(name, *plan)
    moved, seen, drawn = sampled(jax.random.key(0), state, jnp.int32(action), params)
    expected = distribution(state, action, params)
    weights, outcomes = expected.weights, expected.outcomes
    assert weights.sum() == pytest.approx(1, abs=1e-6)
    mean = weights @ outcomes
    width = np.asarray(params.perception_width)
    spread = np.sqrt(weights @ (outcomes - mean[None]) ** 2)
    np.testing.assert_allclose(mean / width, np.mean(moved, 0) / width, atol=0.05)
    np.testing.assert_allclose(spread / width, np.std(moved, 0) / width, rtol=0.1, atol=0.02)
    # what is seen is as likely as what the distribution itself draws
    found, own = (np.asarray(log_probs(state, action, params, points)) for points in (seen, drawn))
    error = np.hypot(found.std(), own.std()) / np.sqrt(len(found))
    assert abs(found.mean() - own.mean()) < 4 * error + 0.01


def test_the_density_integrates_to_one():
    params, state = TASKS["rain"].params, after("rain", IDLE)
    expected = distribution(state, SLOWER, params)
    centre, reach = np.asarray(expected.outcomes).mean(0), 6 * np.asarray(params.perception_width)
    ticks = [np.linspace(c - r, c + r, 41) for c, r in zip(centre, reach, strict=True)]
    points = np.stack(np.meshgrid(*ticks, indexing="ij"), -1).reshape(-1, 3).astype(np.float32)
    cell = math.prod(np.diff(tick)[0] for tick in ticks)
    assert np.exp(log_probs(state, SLOWER, params, points)).sum() * cell == pytest.approx(1, abs=1e-3)


@property_of_all
@given(seeds, plans, st.sampled_from(["dry", "rain"]), st.floats(-40, 40), st.floats(-8, 8))
def test_relative_log_density_and_entropy(seed, plan, name, ahead, aside):
    params = TASKS[name].params
    state, _ = reset(jax.random.key(seed), params)
    expected = distribution(state, jnp.int32(plan[0]), params)
    relative = expected.relative_log_prob(expected.outcomes[0] + jnp.array([ahead, aside, 0.0], jnp.float32))
    assert np.isfinite(relative)
    assert relative <= 0
    kernel = -np.sum(np.log(params.perception_width) + 0.5 * np.log(2 * np.pi))
    point = expected.outcomes[1] + 0.5
    assert expected.log_prob(point) - expected.relative_log_prob(point) == pytest.approx(kernel, rel=1e-4)
    assert expected.relative_entropy() >= 0


@pytest.mark.parametrize("params", [highway.make_params(), highway.make_params(friction_mean=0.5)])
def test_without_randomness_a_prediction_scores_zero(params):
    state, _ = reset(jax.random.key(0), params)
    for action in (LANE_LEFT, SLOWER):
        moved = ROAD.perceive(step(jax.random.key(1), state, jnp.int32(action), params).state)
        expected = distribution(state, jnp.int32(action), params)
        assert abs(expected.relative_log_prob(moved)) < 1e-5
        assert abs(expected.relative_entropy()) < 1e-5


@pytest.mark.parametrize("points", [3, 5, 9])
def test_friction_nodes_keep_mean_and_variance(points):
    nodes = environment.friction_nodes(points)
    clipped = np.clip(np.random.default_rng(0).normal(size=400_000), -2, 2)
    assert nodes.mean() == pytest.approx(0, abs=1e-12)
    assert nodes.std() == pytest.approx(clipped.std(), rel=5e-3)


def test_braking_in_the_rain_surprises_a_human_who_believes_the_road_dry():
    task = TASKS["rain"]
    state = after("rain", IDLE, SLOWER)  # what the road denies shows best once the braking is under way
    outcomes = np.asarray(distribution(state, jnp.int32(SLOWER), task.params).outcomes)
    score = jax.jit(
        jax.vmap(lambda outcome, mind: distribution(state, SLOWER, mind).relative_log_prob(outcome), (0, None))
    )
    biased, unbiased = (score(outcomes, task.beliefs[mind]).mean() for mind in ("biased", "unbiased"))
    assert biased < unbiased - 0.05
    wide = lambda mind: mind.replace(perception_width=jnp.array([1.0, 0.3, 1.0]))
    sharp = [score(outcomes, wide(task.beliefs[mind])).mean() for mind in ("biased", "unbiased")]
    assert sharp[0] < sharp[1] - 0.3, "the more so the better one tells speeds apart"
