"""The navigation worlds: what holds everywhere, for what is true and for whatever a human believes."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import peps_envs
from peps_envs import environment, navigation
from peps_envs.navigation import NOWHERE, Navigation, NavigationState, make_params

WORLD = Navigation()
TASKS = {name: peps_envs.make(f"nav-{name}") for name in navigation.DOMAINS}
MINDS = {(name, "truth"): task.params for name, task in TASKS.items()} | {
    (name, belief): params for name, task in TASKS.items() for belief, params in task.beliefs.items()
}
BLOCK = (1.5, 1.5, 4.5, 4.5)
EVERYWHERE = (0.0, 0.0, 6.0, 6.0)
SLACK = 2e-4  # arena units: how far rounding may carry a position across a face

property_of_all = settings(deadline=None, derandomize=True, max_examples=80)
minds = st.sampled_from(list(MINDS.values()))
# the faces of block, grounds and arena are where mistakes hide
coordinates = st.sampled_from([0.0, 0.75, 1.5, 4.5, 5.0, 6.0]) | st.floats(0, 6, width=32)
actions = st.tuples(st.floats(-1.5, 1.5, width=32), st.floats(-1.5, 1.5, width=32)).map(np.float32)
seeds = st.integers(0, 2**31 - 1)


@st.composite
def positions(draw, of=minds):
    """Parameters and a position that they allow."""
    params = draw(of)
    x, y = draw(coordinates), draw(coordinates)
    left, top, right, bottom = np.asarray(params.walls)[0]
    if left < x < right and top < y < bottom:
        x = left if x < 3 else right
    return params, np.float32([x, y])


def at(position, time=0) -> NavigationState:
    return NavigationState(jnp.asarray(position, jnp.float32), jnp.asarray(time, jnp.int32))


@jax.jit
def distribution(position, action, params):
    return WORLD.next_state_distribution(at(position), action, params)


@jax.jit
def relative_log_prob(position, action, perceived, params):
    return WORLD.next_state_distribution(at(position), action, params).relative_log_prob(perceived)


@jax.jit
def relative_entropy(position, action, params):
    return WORLD.next_state_distribution(at(position), action, params).relative_entropy()


@jax.jit
def step(seed, state, action, params):
    return WORLD.step(jax.random.key(seed), state, action, params)


@jax.jit
def wander(seed, position, drift, params):
    """16 walks of 25 random steps from `position`, ends of episodes ignored: all steps, (16, 25, ...)."""

    def move(state, key):
        key_act, key_env = jax.random.split(key)
        action = drift + jax.random.uniform(key_act, (2,), minval=-1.0, maxval=1.0)
        after = WORLD.step(key_env, state, action, params)
        return after.state, (state.position, after)

    walk = lambda key: jax.lax.scan(move, at(position), jax.random.split(key, 25))[1]
    return jax.vmap(walk)(jax.random.split(jax.random.key(seed), 16))


@property_of_all
@given(positions(), actions, seeds)
def test_nobody_leaves_the_arena_or_enters_a_wall(place, drift, seed):
    params, start = place
    before, after = wander(seed, start, drift, params)
    for leaf in jax.tree.leaves(after):
        assert np.all(np.isfinite(leaf))
    position = np.asarray(after.state.position)
    assert np.all(position >= 0)
    assert np.all(position <= np.asarray(params.size))
    for wall in np.asarray(params.walls):
        depth = np.minimum(position - wall[:2], wall[2:] - position).min(-1)
        assert np.all(depth <= SLACK)
    # 6.5 standard deviations are more than a float32 normal ever draws
    noise = np.hypot(params.pit_noise, params.ice_noise)
    assert np.all(np.abs(position - before) <= params.step_length + 6.5 * noise + SLACK)
    assert np.all(np.abs(after.observation) <= 1 + 1e-6)
    assert not np.any(after.terminated & after.truncated)


@property_of_all
@given(positions(), actions)
def test_a_step_is_bounded_in_every_direction(place, action):
    params, position = place
    expected = distribution(position, action, params)
    assert np.linalg.norm(expected.target - position) <= params.step_length + SLACK
    assert 0 <= expected.noise <= np.hypot(params.pit_noise, params.ice_noise) + 1e-6
    assert 0 <= expected.stuck <= 1


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


@property_of_all
@given(positions(), actions, seeds, st.integers(0, 250))
def test_an_episode_ends_in_one_way_only(place, action, seed, time):
    params, position = place
    after = step(seed, at(position, time), action, params)
    assert not (after.terminated and after.truncated)
    assert bool(after.truncated) == (time + 1 >= WORLD.horizon and not after.terminated)
    assert bool(after.terminated) == bool(after.events.any())
    assert after.state.time == time + 1


@property_of_all
@given(positions())
def test_observations_say_where_one_is(place):
    params, position = place
    observation = WORLD.observe(at(position), params)
    np.testing.assert_allclose(WORLD.perceive_observation(observation, params), position, atol=1e-5)


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


# Steps and rewards


@pytest.mark.parametrize("name", ["d1", "d2"])
def test_the_first_two_domains_are_deterministic(name):
    params = TASKS[name].params
    for position in ([0.75, 0.5], [1.9, 0.9], [5.0, 5.0]):
        assert distribution(jnp.array(position), jnp.ones(2), params).noise == 0
        first, second = (step(seed, at(position), jnp.ones(2), params).state.position for seed in (0, 1))
        np.testing.assert_array_equal(first, second)


@property_of_all
@given(st.floats(2.5, 3.5, width=32), st.floats(0, 1, width=32), st.floats(-1, 1, width=32))
def test_walls_stop_and_let_slide(along, towards, sideways):
    params = make_params(walls=(BLOCK,))
    length = 0.75 / max(0.85, np.hypot(towards, sideways))
    for face, axis, sign in ((1.5, 0, 1), (4.5, 0, -1), (1.5, 1, 1), (4.5, 1, -1)):
        position, action = np.float32([along, along]), np.float32([sideways, sideways])
        position[axis], action[axis] = face, sign * towards
        after = np.asarray(step(0, at(position), action, params).state.position)
        assert after[axis] == pytest.approx(face)
        assert after[1 - axis] == pytest.approx(along + length * sideways, abs=1e-5)


def test_a_step_stops_at_the_wall_and_at_the_arenas_edge():
    params = make_params(walls=(BLOCK,))
    np.testing.assert_allclose(step(0, at([1.2, 3.0]), jnp.array([1.0, 0.0]), params).state.position, [1.5, 3.0])
    np.testing.assert_allclose(step(0, at([0.2, 3.0]), jnp.array([-1.0, 0.0]), params).state.position, [0.0, 3.0])


def test_a_steps_length_is_bounded_and_had_before_the_squares_edge():
    for action, length in (
        ([1.0, 0.0], 0.75),
        ([1.0, 1.0], 0.75),
        ([5.0, -5.0], 0.75),
        ([0.0, 0.85], 0.75),
        ([0.425, 0.0], 0.375),
    ):
        moved = step(0, at([3.0, 3.0]), jnp.array(action), make_params()).state.position - jnp.array([3.0, 3.0])
        assert np.linalg.norm(moved) == pytest.approx(length, rel=1e-5)


def test_ground_scales_steps():
    params = make_params(ice=(0.0, 0.0, 1.0, 6.0), ice_gain=0.5, sand=(5.0, 0.0, 6.0, 6.0), sand_gain=0.1)
    for x, gain in ((0.5, 0.5), (3.0, 1.0), (5.5, 0.1)):
        after = step(0, at([x, 3.0]), jnp.array([0.0, 1.0]), params).state.position
        np.testing.assert_allclose(after, [x, 3 + 0.75 * gain], rtol=1e-5)


def test_time_runs_out_at_the_horizon():
    world = Navigation(horizon=3)
    state, _ = world.reset(jax.random.key(0), TASKS["d1"].params)
    step, truncated = jax.jit(world.step), []
    for _ in range(3):
        after = step(jax.random.key(0), state, jnp.zeros(2), TASKS["d1"].params)
        state = after.state
        truncated.append(bool(after.truncated))
        assert not after.terminated
    assert truncated == [False, False, True]


@pytest.mark.parametrize(
    ("position", "action", "progress", "extra", "event"),
    [
        ((3.0, 0.5), (1.0, 0.0), 0.75, 0.0, None),
        ((3.0, 0.5), (-0.5, 0.0), -0.375, 0.0, None),
        ((4.5, 0.5), (1.0, 0.0), 0.5, 100.0, "goal_reached"),
        ((0.5, 4.5), (0.0, 1.0), None, -100.0, "pit_reached"),
    ],
)
def test_reward_is_step_plus_progress_plus_ends(position, action, progress, extra, event):
    params = make_params(pit=(0.0, 5.0, 1.0, 6.0), full_action=1.0)
    after = step(0, at(position), jnp.array(action), params)
    if progress is None:
        progress = np.hypot(4.5, 3.5) - np.hypot(4.5, 4.25)
    assert after.reward == pytest.approx(-1 + progress + extra, rel=1e-5)
    for name in WORLD.event_names:
        assert bool(environment.event(WORLD, after.events, name)) == (name == event)
    assert bool(after.terminated) == (event is not None)


@pytest.mark.parametrize("mind", ["reward", "both"])
@pytest.mark.parametrize("name", ["d1", "d4"])
def test_a_belief_has_reward_weights_of_its_own(name, mind):
    task = TASKS[name]
    belief, state, action = task.beliefs[mind], at(task.params.start), jnp.array([1.0, 0.0])
    after = step(0, state, action, task.params)
    progress = float(after.reward - task.params.step_reward)  # the true weight of progress is 1
    assert after.reward == WORLD.reward(state, action, after.state, task.params)  # r_A is the truth's
    assert WORLD.reward(state, action, after.state, belief) == pytest.approx(-0.5 + 2 * progress, rel=1e-5)
    pit = at((task.params.pit[:2] + task.params.pit[2:]) / 2)
    assert WORLD.reward(pit, action, pit, task.params) == -101
    assert WORLD.reward(pit, action, pit, belief) == pytest.approx(-200.5)


@pytest.mark.parametrize("name", list(TASKS))
def test_what_each_belief_is_about(name):
    truth, beliefs = TASKS[name].params, TASKS[name].beliefs
    assert TASKS[name].default_belief == "biased"
    weights = {"goal_reward", "pit_reward", "step_reward", "progress_reward"}
    different = {
        mind: {field for field in vars(truth) if not np.array_equal(getattr(belief, field), getattr(truth, field))}
        for mind, belief in beliefs.items()
    }
    assert not different["unbiased"]
    assert not different["biased"] & weights
    assert different["reward"] <= weights
    assert different["both"] == different["biased"] | different["reward"]
    for belief in beliefs.values():  # the two MDPs share start, goal and map
        for field in ("size", "start", "goal", "pit", "walls", "ice", "sand", "perception_width"):
            np.testing.assert_array_equal(getattr(belief, field), getattr(truth, field))


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


# At the door


def test_an_unknown_parameter_is_refused():
    with pytest.raises(ValueError, match=r"^navigation parameter 'gaol': known are size, .*"):
        make_params(gaol=NOWHERE)


def test_an_unknown_event_is_refused():
    with pytest.raises(ValueError, match=r"^event 'fell': Navigation has goal_reached, pit_reached$"):
        environment.event(WORLD, jnp.zeros(2, bool), "fell")
