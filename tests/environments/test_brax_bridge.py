"""The environments as Brax environments, alone and in Brax's own wrappers."""

import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import peps_envs
from peps_envs import navigation

with warnings.catch_warnings():  # a library that Brax imports announces its retirement
    warnings.filterwarnings("ignore", "JAXopt is no longer maintained", DeprecationWarning)
    from brax.envs.wrappers import training

    from peps_envs.bridges.to_brax import BraxEnvironment

EAST, STILL = jnp.array([1.0, 0.0]), jnp.zeros(2)
TASK = peps_envs.make("nav-d1")


def noisy_params():
    return navigation.make_params(ice=(0.0, 0.0, 6.0, 6.0), ice_noise=0.3, start=(3.0, 3.0), goal=navigation.NOWHERE)


def run(env, state, action, steps):
    """The states after each of `steps` equal actions, stacked."""

    def step(state, _):
        state = env.step(state, action)
        return state, state

    return jax.jit(lambda state: jax.lax.scan(step, state, None, steps)[1])(state)


@pytest.mark.parametrize("make_key", [jax.random.key, jax.random.PRNGKey])
def test_shows_what_the_environment_does(make_key):
    env = BraxEnvironment(TASK.environment, TASK.params)
    assert (env.observation_size, env.action_size) == (env.environment.observation_size, 2)
    assert isinstance(env.backend, str)
    assert env.unwrapped is env
    state = env.reset(make_key(0))
    assert jax.tree.map(jnp.shape, (state.obs, state.reward, state.done)) == ((env.observation_size,), (), ())
    after = env.step(state, EAST)
    expected = TASK.environment.step(jax.random.key(0), state.pipeline_state, EAST, TASK.params)  # D1 is deterministic
    np.testing.assert_allclose(after.obs, expected.observation)
    np.testing.assert_allclose(after.reward, expected.reward)
    assert set(after.metrics) == set(TASK.environment.event_names)
    assert jax.tree.structure(after) == jax.tree.structure(state)  # so that a scan can carry it
    assert jax.tree.map(lambda leaf: leaf.dtype, after) == jax.tree.map(lambda leaf: leaf.dtype, state)


def test_done_is_terminated_and_the_pit_is_an_event():
    env = BraxEnvironment(TASK.environment, TASK.params)
    states = run(env, env.reset(jax.random.PRNGKey(0)), EAST, 2)  # from (0.75, 0.5) into the pit at x = 2
    np.testing.assert_array_equal(states.done, [0.0, 1.0])
    np.testing.assert_array_equal(states.info["terminated"], [False, True])
    np.testing.assert_array_equal(states.metrics["pit_reached"], [0.0, 1.0])
    assert not states.info["truncated"].any()


def test_the_environments_horizon_is_reported_and_does_not_end_anything():
    env = BraxEnvironment(navigation.Navigation(horizon=3), TASK.params)
    states = run(env, env.reset(jax.random.PRNGKey(0)), STILL, 3)
    np.testing.assert_array_equal(states.info["truncated"], [False, False, True])
    assert not states.done.any()


def test_steps_differ_and_keys_decide():
    env = BraxEnvironment(navigation.Navigation(), noisy_params())
    first, again, other = (run(env, env.reset(jax.random.PRNGKey(seed)), STILL, 4).obs for seed in (0, 0, 1))
    np.testing.assert_array_equal(first, again)
    assert not np.allclose(first, other)
    assert len(np.unique(np.diff(first[:, 0]).round(6))) == 3


@pytest.mark.parametrize("episode_length", [4, 7])
def test_episode_wrapper_calls_time_truncation(episode_length):
    short = navigation.Navigation(horizon=4)
    env = training.EpisodeWrapper(BraxEnvironment(short, TASK.params), episode_length, action_repeat=1)
    states = run(env, env.reset(jax.random.PRNGKey(0)), STILL, episode_length)
    last = np.arange(episode_length) == episode_length - 1
    np.testing.assert_array_equal(states.done, last)
    np.testing.assert_array_equal(states.info["truncation"], last)
    assert not states.info["terminated"].any()


def test_episode_wrapper_does_not_call_an_end_at_the_last_moment_truncation():
    env = training.EpisodeWrapper(BraxEnvironment(navigation.Navigation(horizon=2), TASK.params), 2, action_repeat=1)
    states = run(env, env.reset(jax.random.PRNGKey(0)), EAST, 2)
    np.testing.assert_array_equal(states.done, [0.0, 1.0])
    np.testing.assert_array_equal(states.info["truncation"], [0.0, 0.0])
    np.testing.assert_array_equal(states.info["terminated"], [False, True])


def test_all_of_brax_training_wrappers():
    """Two environments, one walks into the pit in its second step and starts again, the other stands until time is out."""
    env = training.wrap(BraxEnvironment(TASK.environment, TASK.params), episode_length=5)
    state = jax.jit(env.reset)(jax.random.split(jax.random.PRNGKey(0), 2))
    start = state.obs
    states = run(env, state, jnp.stack([EAST, STILL]), 10)
    np.testing.assert_array_equal(states.done[:, 0], [0, 1] * 5)
    np.testing.assert_array_equal(states.done[:, 1], [0, 0, 0, 0, 1] * 2)
    np.testing.assert_array_equal(states.info["terminated"], [[False, False], [True, False]] * 5)
    np.testing.assert_array_equal(states.info["truncation"][:, 1], [0, 0, 0, 0, 1] * 2)
    assert not states.info["truncation"][:, 0].any()
    ended = states.done == 1
    np.testing.assert_array_equal(states.obs[ended], np.broadcast_to(start[0], states.obs[ended].shape))
    np.testing.assert_array_equal(states.pipeline_state.time[ended], 0)  # the environment's own clock starts again, too
    metrics = states.info["episode_metrics"]
    np.testing.assert_array_equal(metrics["pit_reached"][ended[:, 0], 0], 1.0)
    np.testing.assert_array_equal(metrics["length"][ended[:, 1], 1], 5.0)
    np.testing.assert_allclose(metrics["sum_reward"][ended[:, 1], 1], -5.0, rtol=1e-6)


def test_an_episode_after_a_reset_is_not_the_first_one_again():
    env = training.wrap(BraxEnvironment(navigation.Navigation(), noisy_params()), episode_length=3)
    states = run(env, env.reset(jax.random.split(jax.random.PRNGKey(0), 1)), STILL[None], 6)
    assert not np.allclose(states.obs[:2], states.obs[3:5])


def test_eval_wrapper_counts_events_once_per_episode():
    env = training.EvalWrapper(training.wrap(BraxEnvironment(TASK.environment, TASK.params), episode_length=5))
    states = run(env, env.reset(jax.random.split(jax.random.PRNGKey(0), 2)), jnp.stack([EAST, STILL]), 10)
    metrics = jax.tree.map(lambda leaf: leaf[-1], states.info["eval_metrics"])
    np.testing.assert_array_equal(metrics.episode_metrics["pit_reached"], [1.0, 0.0])
    np.testing.assert_array_equal(metrics.active_episodes, [0.0, 0.0])


def test_new_keys_work_in_a_batch():
    env = training.VmapWrapper(BraxEnvironment(navigation.Navigation(), noisy_params()))
    states = run(env, env.reset(jax.random.split(jax.random.key(0), 3)), jnp.zeros((3, 2)), 2)
    assert states.obs.shape == (2, 3, env.observation_size)
    assert len(np.unique(states.obs[-1, :, 0])) == 3


def test_discrete_actions_are_refused_in_one_line():
    class Buttons(navigation.Navigation):
        action_space = peps_envs.Discrete(4)

    with pytest.raises(ValueError, match=r"^action_space Discrete\(size=4\): .*Box$"):
        BraxEnvironment(Buttons(), TASK.params)
