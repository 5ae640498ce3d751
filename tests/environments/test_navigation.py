"""The navigation domains: what holds everywhere, for what is true and for whatever a human believes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from navigation_cases import (
    BLOCK,
    EVERYWHERE,
    MINDS,
    NAVIGATION,
    SLACK,
    TASKS,
    actions,
    at,
    distribution,
    minds,
    positions,
    property_of_all,
    seeds,
    step,
)

from peps_envs.environment import event
from peps_envs.navigation import NOWHERE, Navigation, make_params


@jax.jit
def wander(seed, position, drift, params):
    """16 walks of 25 random steps from `position`, ends of episodes ignored: all steps, (16, 25, ...)."""

    def move(state, key):
        key_act, key_env = jax.random.split(key)
        action = drift + jax.random.uniform(key_act, (2,), minval=-1.0, maxval=1.0)
        after = NAVIGATION.step(key_env, state, action, params)
        return after.state, (state.position, after)

    walk = lambda key: jax.lax.scan(move, at(position), jax.random.split(key, 25))[1]
    return jax.vmap(walk)(jax.random.split(jax.random.key(seed), 16))


@jax.jit
def judged_and_alone(seed, position, action, params, belief):
    """Where 16 steps lead that are judged, and the same ones by themselves."""
    state, keys = at(position), jax.random.split(jax.random.key(seed), 16)
    judged = jax.vmap(lambda key: NAVIGATION.judged_step(key, state, action, params, belief)[0].state)(keys)
    return judged, jax.vmap(lambda key: NAVIGATION.step(key, state, action, params).state)(keys)


@property_of_all
@given(positions(), minds, actions, seeds)
def test_a_judged_step_is_the_true_one_whatever_is_believed(place, belief, action, seed):
    params, start = place
    judged, alone = judged_and_alone(seed, start, action, params, belief)
    jax.tree.map(lambda *both: np.testing.assert_allclose(*both, atol=1e-5), judged, alone)


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
@given(positions(), actions, seeds, st.integers(0, 250))
def test_an_episode_ends_in_one_way_only(place, action, seed, time):
    params, position = place
    after = step(seed, at(position, time), action, params)
    assert not (after.terminated and after.truncated)
    assert bool(after.truncated) == (time + 1 >= NAVIGATION.horizon and not after.terminated)
    assert bool(after.terminated) == bool(after.events.any())
    assert after.state.time == time + 1


@property_of_all
@given(positions())
def test_observations_say_where_one_is(place):
    params, position = place
    observation = NAVIGATION.observe(at(position), params)
    np.testing.assert_allclose(NAVIGATION.position_of(observation, params), position, atol=1e-5)


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
    short = Navigation(horizon=3)
    state, _ = short.reset(jax.random.key(0), TASKS["d1"].params)
    step, truncated = jax.jit(short.step), []
    for _ in range(3):
        after = step(jax.random.key(0), state, jnp.zeros(2), TASKS["d1"].params)
        state = after.state
        truncated.append(bool(after.truncated))
        assert not after.terminated
    assert truncated == [False, False, True]


@pytest.mark.parametrize(
    ("position", "action", "progress", "extra", "happened"),
    [
        ((3.0, 0.5), (1.0, 0.0), 0.75, 0.0, None),
        ((3.0, 0.5), (-0.5, 0.0), -0.375, 0.0, None),
        ((4.5, 0.5), (1.0, 0.0), 0.5, 100.0, "goal_reached"),
        ((0.5, 4.5), (0.0, 1.0), None, -100.0, "pit_reached"),
    ],
)
def test_reward_is_step_plus_progress_plus_ends(position, action, progress, extra, happened):
    params = make_params(pit=(0.0, 5.0, 1.0, 6.0), full_action=1.0)
    after = step(0, at(position), jnp.array(action), params)
    if progress is None:
        progress = np.hypot(4.5, 3.5) - np.hypot(4.5, 4.25)
    assert after.reward == pytest.approx(-1 + progress + extra, rel=1e-5)
    for name in NAVIGATION.event_names:
        assert bool(event(NAVIGATION, after.events, name)) == (name == happened)
    assert bool(after.terminated) == (happened is not None)


@pytest.mark.parametrize("mind", ["reward", "both"])
@pytest.mark.parametrize("name", ["d1", "d4"])
def test_a_belief_has_reward_weights_of_its_own(name, mind):
    task = TASKS[name]
    belief, state, action = task.beliefs[mind], at(task.params.start), jnp.array([1.0, 0.0])
    after = step(0, state, action, task.params)
    progress = float(after.reward - task.params.step_reward)  # the true weight of progress is 1
    assert after.reward == NAVIGATION.reward(state, action, after.state, task.params)  # r_A is the truth's
    assert NAVIGATION.reward(state, action, after.state, belief) == pytest.approx(-0.5 + 2 * progress, rel=1e-5)
    pit = at((task.params.pit[:2] + task.params.pit[2:]) / 2)
    assert NAVIGATION.reward(pit, action, pit, task.params) == -101
    assert NAVIGATION.reward(pit, action, pit, belief) == pytest.approx(-200.5)


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


# At the door


def test_an_unknown_parameter_is_refused():
    with pytest.raises(ValueError, match=r"^navigation parameter 'gaol': known are size, .*"):
        make_params(gaol=NOWHERE)


def test_an_unknown_event_is_refused():
    with pytest.raises(ValueError, match=r"^event 'fell': Navigation has goal_reached, pit_reached$"):
        event(NAVIGATION, jnp.zeros(2, bool), "fell")


# Numbers


def everything(position, action, params):
    """All that the environment computes at a position."""
    state, key = at(position, dtype=params.start.dtype), jax.random.key(0)
    first = NAVIGATION.reset(key, params)
    density = NAVIGATION.next_state_distribution(state, action, params)
    scores = density.log_prob(params.start), density.relative_log_prob(params.start), density.relative_entropy()
    return first, NAVIGATION.step(key, state, action, params), scores, density.sample(key), density.quadrature(3)


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_with_64_bits_every_number_has_the_parameters_precision(dtype):
    with jax.enable_x64(True):
        params = jax.tree.map(lambda leaf: jnp.asarray(leaf, dtype), make_params(ice=EVERYWHERE, ice_noise=0.3))
        found = jax.eval_shape(everything, jnp.ones(2), jnp.ones(2), params)
        (state, observation), after, *rest = found
        assert (after.state.time.dtype, after.events.dtype, after.terminated.dtype) == (jnp.int32, bool, bool)
        real = [state.position, observation, after.state.position, after.observation, after.reward, rest]
        assert {leaf.dtype for leaf in jax.tree.leaves(real)} == {jnp.dtype(dtype)}
        assert make_params().size.dtype == jnp.float64


def test_nothing_is_ever_not_a_number():
    """Nor on the way to a result, nor a gradient in what is believed: at walls, edges and corners, in all minds."""
    ticks = np.array([0.0, 1.5, 3.0, 4.5, 6.0], np.float32)
    places = np.stack(np.meshgrid(ticks, ticks), -1).reshape(-1, 2)
    score = lambda params, *moment: sum(jax.tree.leaves(everything(*moment, params)[2]))
    value, slope = (
        jax.jit(jax.vmap(function, (0, None, None)))
        for function in (everything, lambda *moment: jax.grad(score)(moment[2], *moment[:2]))
    )
    with jax.debug_nans(True):
        for mind in MINDS.values():
            for action in (jnp.zeros(2), jnp.array([1.0, -1.0])):
                value(places, action, mind)
                slope(places, action, mind)
