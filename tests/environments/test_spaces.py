"""What environments say of their observations holds in random episodes, and is no larger than it has to be."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import peps_envs
from peps_envs import Bounds, Discrete, highway

ENVIRONMENTS = {
    "navigation": ("nav-d3", peps_envs.make("nav-d3").environment),
    "highway": ("highway-rain", highway.Highway()),
    "traffic": ("highway-rain", highway.Highway(traffic=3, changes=True)),
    "classic": ("highway-rain", highway.ClassicHighway()),
}
EPISODES = 300


@functools.partial(jax.jit, static_argnames="environment")
def observations(environment, params, key):
    """What is observed in `EPISODES` of random actions, some of them held for long: (EPISODES, horizon + 1, size)."""
    space = environment.action_space

    def act(key):
        if isinstance(space, Discrete):
            return jax.random.randint(key, (), 0, space.size)
        return jnp.sign(jax.random.normal(key, (space.size,)))

    def move(carry, key):
        state, action = carry
        key_keep, key_act, key_env = jax.random.split(key, 3)
        action = jnp.where(jax.random.bernoulli(key_keep, 0.7), action, act(key_act))
        after = environment.step(key_env, state, action, params)
        return (after.state, action), after.observation

    def episode(key):
        key_start, key_act, key_moves = jax.random.split(key, 3)
        state, first = environment.reset(key_start, params)
        keys = jax.random.split(key_moves, min(environment.horizon, 40))
        _, later = jax.lax.scan(move, (state, act(key_act)), keys)
        return jnp.concatenate([first[None], later])

    return jax.vmap(episode)(jax.random.split(key, EPISODES))


@pytest.mark.parametrize("name", ENVIRONMENTS)
def test_observations_lie_within_the_stated_bounds(name):
    task, environment = ENVIRONMENTS[name]
    low, high = (
        np.broadcast_to(limit, environment.observation_size)
        for limit in (environment.observation_space.low, environment.observation_space.high)
    )
    params = peps_envs.make(task).params
    seen = np.asarray(observations(environment, params, jax.random.key(0))).reshape(-1, environment.observation_size)
    rounding = 1e-5
    assert np.all(seen >= low - rounding)
    assert np.all(seen <= high + rounding)
    if name != "classic":  # which is scaled by far more than ever happens on this road
        reached = (seen.max(0) - seen.min(0)) / (high - low)
        assert np.all(reached[np.isfinite(high - low)] > 0.25), reached


def test_by_default_there_are_no_bounds():
    assert peps_envs.Environment.observation_space == Bounds(-np.inf, np.inf)
