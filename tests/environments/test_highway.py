"""The road: collisions, the friction circle, and the scenario in which the car in front brakes."""

import math

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from highway_cases import GRAVITY, ROAD, TASKS, plans, property_of_all, reset, seeds
from hypothesis import given
from hypothesis import strategies as st

import peps_envs
from peps_envs import highway
from peps_envs.environment import event
from peps_envs.highway import classic, collision, environment, simulation, vehicle
from peps_envs.highway.vehicle import FASTER, IDLE, LANE_LEFT, LANE_RIGHT, LANE_WIDTH, SLOWER, Control


def test_a_meta_action_may_be_a_plain_number():
    state, _ = reset(jax.random.key(0), TASKS["dry"].params)
    decide = lambda action: vehicle.decide(state.vehicles, action, jnp.array([20.0, 25.0, 30.0]), 2)
    for action in range(5):
        jax.tree.map(np.testing.assert_array_equal, decide(action), decide(jnp.int32(action)))


# Collisions


@property_of_all
@given(st.floats(-6, 6), st.floats(-4, 4), st.floats(-3.2, 3.2), st.floats(-3.2, 3.2))
def test_cars_intersect_where_one_covers_a_point_of_the_other(x, y, first, second):
    unit = lambda angle: (np.cos(angle), np.sin(angle))
    still = jnp.zeros(1)
    boxes = [tuple(jnp.asarray([value], jnp.float32) for value in pair) for pair in ((x, y), unit(first), unit(second))]
    intersects, will_intersect, push_x, push_y = collision.meet(*boxes, (still, still), 0.0)
    assert intersects == will_intersect  # nobody moves

    grid = np.stack(np.meshgrid(np.linspace(-2.5, 2.5, 81), np.linspace(-1, 1, 33)), -1).reshape(-1, 2)
    turn = lambda angle: np.array([unit(angle), (-np.sin(angle), np.cos(angle))])
    in_first = (grid @ turn(second) + (x, y)) @ turn(first).T
    depth = np.minimum(2.5 - np.abs(in_first[:, 0]), 1 - np.abs(in_first[:, 1])).max()
    if abs(depth) > 0.1:  # the grid is no finer
        assert bool(intersects[0]) == (depth > 0)
    if intersects[0]:  # the translation parts them, and nothing shorter does along its direction
        apart = tuple(jnp.asarray([value], jnp.float32) for value in (x, y))
        for share, expected in ((1.01, False), (0.9, True)):
            moved = (apart[0] - share * push_x, apart[1] - share * push_y)
            if np.hypot(push_x, push_y) > 0.05:
                assert bool(collision.meet(moved, *boxes[1:], (still, still), 0.0)[0][0]) == expected


# Friction


@property_of_all
@given(
    st.floats(-0.625, 0.625, width=32), st.floats(-20, 20, width=32), st.floats(-5, 40, width=32),
    st.floats(0.0625, 1.5, width=32) | st.just(math.inf),
)  # fmt: skip
def test_what_is_left_of_a_command_lies_in_the_friction_circle(slip, acceleration, speed, mu):
    asked = Control(jnp.float32(slip), jnp.float32(acceleration))
    left = vehicle.grip(asked, jnp.float32(speed), jnp.float32(mu), jnp.float32(6))
    if math.isinf(mu):
        assert left == asked
        return
    rate = speed * float(left.slip) / (vehicle.LENGTH / 2)
    assert abs(rate) <= mu * GRAVITY / max(speed, 1) * (1 + 1e-5)
    assert math.hypot(speed * rate, left.acceleration) <= mu * GRAVITY * (1 + 1e-5) or speed < 1
    assert left.acceleration <= 6
    # a command is weakened and never reversed
    for kept, whole in zip(left, asked, strict=True):
        assert abs(kept) <= abs(whole)
        assert kept * whole >= 0


@jax.jit
def drive(seed, plan, params):
    """The ego's heading and speed in an episode's 8 steps, (8, 16) each, whether it crashed in them, and the road's mu (8,)."""
    key_reset, key_mu = jax.random.split(jax.random.key(seed))
    state, _ = ROAD.reset(key_reset, params)
    friction = params.physics.friction
    coefficients = friction.mean + friction.sd * jnp.clip(jax.random.normal(key_mu, (8,)), -2, 2)

    def step(state, move):
        action, mu = move
        before = state.vehicles
        after, (trace, _) = simulation.advance(ROAD.road, before, state.drivers, state.time, action, mu, params.physics)
        join = lambda first, later: jnp.concatenate([first[None, 0], later[:, 0]])
        path = join(before.heading, trace.heading), join(before.speed, trace.speed), trace.crashed[:, 0].any()
        return state.replace(vehicles=after, time=state.time + 1), path

    _, path = jax.lax.scan(step, state, (plan, coefficients))
    return *path, coefficients


@property_of_all
@given(seeds, plans, st.sampled_from(["dry", "rain"]))
def test_no_step_turns_or_brakes_more_than_the_road_allows(seed, plan, name):
    heading, speed, crashed, coefficients = (np.asarray(leaf) for leaf in drive(seed, plan, TASKS[name].params))
    for step in range(len(plan)):
        if crashed[step]:
            break
        most = coefficients[step] * GRAVITY / 15
        assert np.all(np.abs(np.diff(speed[step])) <= most + 1e-4)
        assert np.all(np.abs(np.diff(heading[step])) <= most / np.maximum(speed[step][:-1], 1) + 1e-5)


@property_of_all
@given(seeds, plans)
def test_an_infinite_coefficient_is_no_limit(seed, plan):
    none = drive(seed, plan, highway.make_params())
    vast = drive(seed, plan, highway.make_params(friction_mean=1e4, engine=1e4))
    for found, expected in zip(none[:2], vast[:2], strict=True):
        assert np.all(np.isfinite(found))
        np.testing.assert_allclose(found, expected, atol=1e-4)


# The scenario


@jax.jit
def episodes(keys, plan, params):
    """Return, whether it crashed, and the steps, of one episode a key that follows `plan` (8,)."""

    def episode(key):
        key_reset, key_steps = jax.random.split(key)

        def step(carry, move):
            state, alive = carry
            action, key = move
            after = ROAD.step(key, state, action, params)
            return (after.state, alive & ~after.terminated), (after, alive)

        start = (ROAD.reset(key_reset, params)[0], jnp.ones((), bool))
        _, (steps, alive) = jax.lax.scan(step, start, (plan, jax.random.split(key_steps, len(plan))))
        crashed = event(ROAD, steps.events, "crashed")
        return jnp.sum(steps.reward * alive), jnp.any(crashed & alive), steps

    return jax.vmap(episode)(keys)


STEER = [IDLE, LANE_LEFT, *[IDLE] * 6]
BRAKE_THEN_STEER = [IDLE, SLOWER, LANE_LEFT, *[IDLE] * 5]
BRAKE = [IDLE, *[SLOWER] * 7]
NOTHING = [IDLE] * 8


@pytest.mark.parametrize(
    ("name", "plan", "crashes", "return_"),
    [
        ("dry", STEER, (0, 0.003), None),
        ("dry", BRAKE_THEN_STEER, (0, 0.003), None),
        ("dry", BRAKE, (0, 0.003), None),
        ("dry", NOTHING, (1, 1), None),
        ("rain", STEER, (0, 0.003), (6.0, 7.0)),
        ("rain", BRAKE_THEN_STEER, (0, 0.003), (5.6, 6.5)),
        ("rain", BRAKE, (0.66, 0.95), (-6.0, -2.0)),
        ("rain", NOTHING, (1, 1), None),
    ],
)
def test_scripted_behaviours_crash_as_often_as_they_should(name, plan, crashes, return_):
    params = highway.make_params(**highway.DOMAINS[name], onset=(1.0, 1.0))
    total, crashed, _ = episodes(jax.random.split(jax.random.key(0), 1000), jnp.array(plan), params)
    assert crashes[0] <= crashed.mean() <= crashes[1]
    if return_:
        assert return_[0] < total.mean() < return_[1]


def test_the_start_is_drawn_within_its_limits():
    params = TASKS["rain"].params
    states, _ = jax.vmap(reset, (0, None))(jax.random.split(jax.random.key(0), 500), params)
    vehicles, drivers = states.vehicles, states.drivers
    drawn = {
        "speed": vehicles.speed[:, 1], "gap": vehicles.x[:, 1] - vehicles.x[:, 0] - vehicle.LENGTH,
        "deceleration": drivers.deceleration[:, 1], "onset": drivers.onset[:, 1],
    }  # fmt: skip
    for name, values in drawn.items():
        low, high = getattr(params.scenario, name)
        assert np.all((values >= low - 1e-4) & (values <= high + 1e-4)), name
        assert np.ptp(values) >= 0.9 * (high - low), name
    np.testing.assert_array_equal(vehicles.speed[:, 0], vehicles.speed[:, 1])
    np.testing.assert_array_equal(vehicles.target_lane, 1)


@property_of_all
@given(seeds, plans, st.sampled_from(["dry", "rain"]))
def test_an_episode_ends_in_one_way_only(seed, plan, name):
    _, crashed, steps = episodes(jax.random.key(seed)[None], jnp.array(plan), TASKS[name].params)
    for leaf in jax.tree.leaves((steps.observation, steps.reward, steps.state.vehicles)):
        assert np.all(np.isfinite(leaf))
    assert not np.any(steps.truncated)
    wrecked = event(ROAD, steps.events, "crashed")
    np.testing.assert_array_equal(steps.terminated, wrecked | (np.arange(8) >= 7)[None])
    assert bool(crashed[0]) == bool(wrecked.any())
    if not crashed[0]:
        assert np.all((steps.reward >= 0) & (steps.reward <= 1))
    sideways = np.asarray(event(ROAD, steps.events, "changed_lane")).sum()
    assert sideways == 0 or {LANE_LEFT, LANE_RIGHT} & set(plan.tolist())


@property_of_all
@given(seeds, plans)
def test_observations_say_what_is_perceived(seed, plan):
    params = TASKS["rain"].params
    _, _, steps = episodes(jax.random.key(seed)[None], jnp.array(plan), params)
    expected = jax.vmap(jax.vmap(ROAD.perceive))(steps.state)
    seen = np.asarray(steps.observation)
    own, gap = seen[..., :2] * [environment.SPEED_SCALE, LANE_WIDTH], seen[..., environment.EGO_FEATURES]
    shown = np.stack([gap * environment.GAP_SCALE - vehicle.LENGTH, own[..., 1], own[..., 0]], -1)
    np.testing.assert_allclose(shown, expected, atol=1e-3)


def test_meta_actions_move_targets():
    params = highway.make_params()
    state, _ = reset(jax.random.key(0), params)
    after = jax.jit(jax.vmap(lambda action: ROAD.advance(state, action, jnp.inf, params).vehicles))(jnp.arange(5))
    np.testing.assert_array_equal(after.target_lane[:, 0], [0, 1, 1, 1, 1])
    np.testing.assert_array_equal(after.target_speed[:, 0], [25, 25, 25, 30, 20])


# The reward


def rated(**changes):
    """The features after a step to a state with `changes` of its vehicles."""
    params = highway.make_params()
    state, _ = reset(jax.random.key(0), params)
    vehicles = state.vehicles.replace(**{name: jnp.asarray(value, jnp.float32) for name, value in changes.items()})
    return jax.jit(ROAD.rate)(state, state.replace(vehicles=vehicles), params)


def test_features_of_the_reward():
    start = environment.START
    features = rated(x=[start + 15, start + 45], y=[4, 4], speed=[20, 5])
    assert features.speed == pytest.approx(15 / 30)  # an average over the step's second
    assert features.distance == pytest.approx(25 / 50)
    assert features.relative_speed == pytest.approx(1 - 15 / 30 * (1 - 25 / 50))
    assert features.lane == pytest.approx(1)
    beside = rated(x=[start + 45, start + 45], y=[1.5, 4], speed=[20, 5])
    assert beside.speed == 1
    assert beside.distance == 1  # nobody is in the way
    assert beside.relative_speed == pytest.approx(0.5)
    assert beside.lane == pytest.approx(0.25)


def test_the_reward_weighs_features_by_their_ratings():
    params = highway.make_params(rating_speed=1.0, rating_distance=0.0, rating_relative_speed=0.0, rating_lane=3.0)
    state, _ = reset(jax.random.key(0), params)
    vehicles = state.vehicles.replace(x=state.vehicles.x.at[0].add(15.0), y=jnp.array([3.0, 4.0]))
    after = state.replace(vehicles=vehicles)
    assert ROAD.reward(state, IDLE, after, params) == pytest.approx(0.25 * 0.5 + 0.75 * 0.5, rel=1e-5)
    wreck = after.replace(vehicles=vehicles.replace(crashed=jnp.array([True, True])))
    assert ROAD.reward(state, IDLE, wreck, params) == pytest.approx(0.5 - 10, rel=1e-5)


def test_moving_sideways_costs_the_more_the_faster():
    params = highway.make_params(lane_change_cost=1.0, swerve_cost=4.0)
    state, _ = reset(jax.random.key(0), params)
    after = state.replace(vehicles=state.vehicles.replace(y=jnp.array([3.0, 4.0])))
    for speed in (0.0, 15.0, 25.0):
        before = state.replace(vehicles=state.vehicles.replace(speed=jnp.array([speed, 25.0])))
        change = ROAD.reward(before, IDLE, after, params) - ROAD.reward(before, IDLE, after, highway.make_params())
        assert change == pytest.approx(-(1 + 4 * (speed / 30) ** 2) / 4, rel=1e-4)


# Presets and transforms


def test_the_presets():
    assert {"highway-dry", "highway-rain"} <= set(peps_envs.names())
    for name, task in TASKS.items():
        assert task.default_belief == "biased"
        assert set(task.beliefs) == {"biased", "unbiased", "reward", "both"}
        friction = lambda params: (float(params.physics.friction.mean), float(params.physics.friction.sd))
        assert friction(task.beliefs["biased"]) == friction(TASKS["dry"].params)
        chex.assert_trees_all_equal(task.beliefs["unbiased"], task.params)
        assert task.beliefs["reward"].swerve_cost > task.params.swerve_cost == 0
        assert friction(task.beliefs["reward"]) == friction(TASKS[name].params)


def test_an_unknown_number_is_refused():
    with pytest.raises(ValueError, match=r"^highway parameter 'frction_mean': known are friction_mean, "):
        highway.make_params(frction_mean=0.5)


def test_batches_of_states_and_of_beliefs():
    beliefs = jax.tree.map(lambda *leaves: jnp.stack(leaves), TASKS["rain"].params, TASKS["dry"].params)
    keys = jax.random.split(jax.random.key(0), 2)
    traced = jax.jit(chex.assert_max_traces(lambda key, params: episodes(key[None], jnp.array(BRAKE), params)[0], 1))
    batched = jax.jit(jax.vmap(traced))(keys, beliefs)
    for index, name in enumerate(("rain", "dry")):
        single = episodes(keys[index][None], jnp.array(BRAKE), TASKS[name].params)[0]
        np.testing.assert_allclose(batched[index], single, rtol=1e-4)


def test_traffic_in_the_other_lane():
    made = highway.Highway(traffic=2, changes=True)
    params = TASKS["rain"].params
    state, observation = jax.jit(made.reset)(jax.random.key(0), params)
    assert observation.shape == (made.observation_size,) == (18,)
    np.testing.assert_array_equal(state.vehicles.y, [4, 4, 0, 0])
    assert state.vehicles.x[2] < state.vehicles.x[0] < state.vehicles.x[3]
    step = jax.jit(made.step)
    for number in range(8):
        after = step(jax.random.key(number), state, jnp.int32(SLOWER), params)
        state = after.state
        assert np.all(np.isfinite(after.observation))
    assert bool(after.truncated | after.terminated)
    assert not np.any(state.vehicles.crashed[2:])


def test_highway_envs_own_observation_and_reward():
    made, params = highway.ClassicHighway(), highway.make_params()
    state, observation = jax.jit(made.reset)(jax.random.key(0), params)
    assert observation.shape == (made.observation_size,)
    ego, ahead = np.asarray(observation).reshape(classic.ROWS, classic.COLUMNS)[:2]
    perceived = [
        ahead[1] * classic.SIGHT - vehicle.LENGTH, ego[2] * LANE_WIDTH * made.lanes, ego[3] * 2 * classic.MAX_SPEED
    ]  # fmt: skip
    np.testing.assert_allclose(perceived, made.perceive(state), atol=1e-3)
    after = jax.jit(made.step)(jax.random.key(0), state, jnp.int32(FASTER), params)
    assert after.reward == pytest.approx((0.4 * min((after.state.vehicles.speed[0] - 20) / 10, 1) + 0.1 + 1) / 1.5)
