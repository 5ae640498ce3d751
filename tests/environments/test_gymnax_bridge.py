"""The environments in gymnax, and gymnax's own as environments with beliefs."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import TINY, Line, LineParams

import peps_envs
from peps_jax import Config

gymnax = pytest.importorskip("gymnax")

from peps_envs.bridges.from_gymnax import from_gymnax  # noqa: E402
from peps_envs.bridges.to_gymnax import GymnaxEnvironment  # noqa: E402

# --- ours in gymnax -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["nav-d3", "highway-rain"])
def test_random_steps_are_the_environments_bit_by_bit(name):
    """20 000 of each, 100 walks at once; what `step_env` returns, whichever episode is over."""
    task = peps_envs.make(name)
    environment, env = task.environment, GymnaxEnvironment(task.environment, task.params)
    params = env.default_params

    def walk(key, reset, step):
        def move(state, key):
            key_act, key_step = jax.random.split(key)
            action = env.action_space(params).sample(key_act)
            state, *seen = step(key_step, state, action)
            return state, seen

        key_start, key_moves = jax.random.split(key)
        return jax.lax.scan(move, reset(key_start), jax.random.split(key_moves, 200))[1]

    def theirs(key, state, action):
        observation, state, reward, terminated, _ = env.step_env(key, state, action, params)
        return state, observation, reward, terminated, env.is_truncated(state, params)

    def ours(key, state, action):
        after = environment.step(key, state, action, task.params)
        return after.state, after.observation, after.reward, after.terminated, after.truncated

    keys = jax.random.split(jax.random.key(0), 100)
    in_gymnax = jax.jit(jax.vmap(lambda key: walk(key, lambda key: env.reset_env(key, params)[1], theirs)))
    itself = jax.jit(jax.vmap(lambda key: walk(key, lambda key: environment.reset(key, task.params)[0], ours)))
    for found, expected in zip(in_gymnax(keys), itself(keys), strict=True):
        np.testing.assert_array_equal(found, expected)
        assert found.shape[:2] == (100, 200)


def test_an_episode_that_is_over_is_followed_by_a_new_one():
    env = GymnaxEnvironment(Line(horizon=4), LineParams())
    params = env.default_params
    observation, state = env.reset(jax.random.key(0), params)
    starts, ends = [observation], []
    for place in range(8):
        observation, state, _, terminated, truncated, info = env.step(
            jax.random.key(place), state, jnp.zeros(1), params
        )
        ends.append((bool(terminated), bool(truncated)))
        if ends[-1][1]:
            np.testing.assert_array_equal(info["final_observation"], starts[-1], "it has stood still")
            starts.append(observation)
            assert state.time == 0
    assert ends == [(False, False)] * 3 + [(False, True)] + [(False, False)] * 3 + [(False, True)]
    assert len({float(start[0]) for start in starts}) == 3


def test_an_end_and_events_are_told():
    env = GymnaxEnvironment(Line(), LineParams())
    params = env.default_params
    assert (env.name, env.num_actions, params.max_steps_in_episode) == ("Line", 1, 8)
    _, state = env.reset_env(jax.random.key(0), params)
    state = state.replace(state=state.state.replace(place=jnp.full(1, 0.2)))
    *_, terminated, truncated, info = env.step(jax.random.key(0), state, jnp.ones(1), params)
    assert (bool(terminated), bool(truncated), bool(info["arrived"]), float(info["discount"])) == (True, False, True, 0)


def test_a_belief_is_another_domain_of_the_same_environment():
    env = GymnaxEnvironment(Line(), LineParams())
    believed = env.default_params.replace(domain=LineParams(slope=2.0))
    _, state = env.reset(jax.random.key(0), believed)
    rewards = [
        env.step_env(jax.random.key(0), state, jnp.zeros(1), params)[2] for params in (env.default_params, believed)
    ]
    np.testing.assert_allclose(2 * rewards[0], rewards[1], rtol=1e-6)


def test_spaces():
    task = peps_envs.make("highway-rain")
    env = GymnaxEnvironment(task.environment, task.params)
    assert env.action_space().n == 5
    space = env.observation_space(env.default_params)
    observation, _ = env.reset(jax.random.key(0), env.default_params)
    assert bool(space.contains(observation))
    assert space.shape == observation.shape


# --- gymnax's with beliefs ------------------------------------------------------------------------------------------------


def pendulum(**changes):
    env, params = gymnax.make("Pendulum-v1")
    pose = lambda state: jnp.stack([jnp.cos(state.theta), jnp.sin(state.theta)])
    return from_gymnax(env, params, pose, width=(0.1, 0.1), **changes), params


def mountain_car(**changes):
    env, params = gymnax.make("MountainCarContinuous-v0")
    return from_gymnax(env, params, lambda state: state.position[None], width=(0.005,), **changes), params


@pytest.mark.parametrize("make", [pendulum, mountain_car])
def test_random_steps_are_gymnaxs_bit_by_bit(make):
    """20 000, of 100 walks at once."""
    environment, params = make()
    env = environment.env
    scale = 2.0 if make is pendulum else 1.0  # the largest torque

    def walk(step, start, key):
        key_start, key_moves = jax.random.split(key)

        def move(state, key):
            key_act, key_step = jax.random.split(key)
            state, *seen = step(key_step, state, jax.random.uniform(key_act, (1,), minval=-1.0))
            return state, seen

        return jax.lax.scan(move, start(key_start), jax.random.split(key_moves, 200))[1]

    def ours(key, state, action):
        after = environment.step(key, state, action, params)
        return after.state, after.observation, after.reward, after.terminated, after.state.inner

    def theirs(key, state, action):
        observation, after, reward, terminated, _ = env.step_env(key, state, scale * action, params)
        return jax.tree.map(jnp.asarray, after), observation, reward, terminated, after

    def their_start(key):
        return env.reset_env(key, params)[1].replace(time=jnp.int32(0))

    keys = jax.random.split(jax.random.key(0), 100)
    found, expected = (
        jax.jit(jax.vmap(lambda key, step=step, start=start: walk(step, start, key)))(keys)
        for step, start in ((ours, lambda key: environment.reset(key, params)[0]), (theirs, their_start))
    )
    for mine, their in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        np.testing.assert_array_equal(mine, their)


@pytest.mark.parametrize(("make", "changes"), [(pendulum, {"m": 2.0}), (mountain_car, {"power": 0.003})])
def test_a_training_with_a_belief(make, changes, train):
    environment, params = make()
    config = Config(env=environment, params=params, belief=params.replace(**changes), **TINY)
    result = train(config)
    assert np.all(np.isfinite(result.curves["explicability"]))
    state, _ = environment.reset(jax.random.key(1), params)
    action = jnp.ones(1)
    perceived = environment.perceive(environment.step(jax.random.key(0), state, action, params).state)
    expects = lambda params: environment.next_state_distribution(state, action, params).relative_log_prob(perceived)
    assert expects(params) == 0
    assert expects(params.replace(**changes)) < -1e-5


def test_the_time_limit_truncates_and_the_goal_terminates():
    environment, params = mountain_car()
    assert environment.horizon == 999
    state, _ = environment.reset(jax.random.key(0), params)
    step = jax.jit(lambda state: environment.step(jax.random.key(0), state, jnp.ones(1), params))
    late = step(state.replace(time=jnp.int32(998)))
    assert (bool(late.terminated), bool(late.truncated)) == (False, True)
    there = step(state.replace(inner=state.inner.replace(position=jnp.float32(0.44), velocity=jnp.float32(0.05))))
    assert (bool(there.terminated), bool(there.truncated)) == (True, False)
    assert there.reward > 99


def test_a_human_wants_what_is_paid_unless_it_is_said():
    flat = lambda state, action, after, params: after.position * params.power
    for environment, params in (mountain_car(), mountain_car(reward=flat)):
        state, _ = environment.reset(jax.random.key(0), params)
        after = environment.step(jax.random.key(0), state, jnp.ones(1), params)
        judged = environment.reward(state, jnp.ones(1), after.state, params.replace(power=1.0))
        ratio = 1.0 if environment.reward_of is None else 1 / params.power
        np.testing.assert_allclose(judged, after.reward * ratio, rtol=1e-5)


@pytest.mark.parametrize(
    ("name", "complaint"),
    [
        ("Breakout-MinAtar", r"^Breakout-MinAtar: observations of shape \(10, 10, 4\), such as pixels, .*`observe`"),
        ("MemoryChain-bsuite", r"^MemoryChain-bsuite: observations hide 'context' of the state, .*`observe`$"),
        ("PointRobot-misc", r"^PointRobot-misc: observations hide 'goal' of the state, .*`observe`$"),
    ],
)
def test_what_cannot_work_is_said_in_one_line(name, complaint):
    env, params = gymnax.make(name)
    with jax.numpy_rank_promotion("allow"), pytest.raises(ValueError, match=complaint):
        from_gymnax(env, params, lambda state: jnp.zeros(1), width=(1.0,))


def test_observations_of_ones_own():
    env, params = gymnax.make("PointRobot-misc")
    both = lambda state: jnp.concatenate([state.pos, state.goal])
    with jax.numpy_rank_promotion("allow"):
        environment = from_gymnax(env, params, lambda state: state.pos, width=(0.1, 0.1), observe=both)
        state, observation = environment.reset(jax.random.key(0), params)
    np.testing.assert_array_equal(observation, both(state.inner))
    environment, params = pendulum()
    with pytest.raises(ValueError, match=r"observations hide 'theta_dot' of the state"):
        pendulum(observe=environment.see)


def test_parameters_of_another_kind_are_refused_in_one_line():
    environment, _ = pendulum()
    _, other = gymnax.make("CartPole-v1")
    with pytest.raises(ValueError, match=r"^Pendulum-v1: parameters of another structure \(EnvParams for EnvParams\)"):
        environment.reset(jax.random.key(0), other)
