"""The environments in gymnax, and gymnax's own as environments with beliefs."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import Line, LineParams

import peps_envs

gymnax = pytest.importorskip("gymnax")

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
