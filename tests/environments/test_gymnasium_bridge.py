"""The environments in Gymnasium: its own checker, the same numbers bit by bit, batches, pictures, and agents on both sides."""

import jax
import numpy as np
import pytest
from conftest import Line, LineParams, untrained
from test_own_environment import Track, Walk

import peps_envs
from peps_envs import registry
from peps_jax import evaluate

gymnasium = pytest.importorskip("gymnasium")
from gymnasium.utils import seeding  # noqa: E402
from gymnasium.utils.env_checker import check_env  # noqa: E402

from peps_envs.bridges import to_gymnasium  # noqa: E402
from peps_envs.bridges.to_gymnasium import GymnasiumEnvironment, GymnasiumVectorEnvironment  # noqa: E402

NOISY = (Line(), LineParams(noise=0.1))


def actions_of(env, number, seed=0):
    env.action_space.seed(seed)
    return [env.action_space.sample() for _ in range(number)]


def told(env, actions, seed):
    """All that Gymnasium is told while `actions` are made, an episode after the other; and whether it lies in the space."""
    rows = [env.reset(seed=seed)[0]]
    for action in actions:
        observation, reward, terminated, truncated, info = env.step(action)
        assert observation in env.observation_space
        rows.append((observation, reward, terminated, truncated, *info.values()))
        if terminated or truncated:
            rows.append(env.reset()[0])
    return rows


def happened(environment, params, actions, seed):
    """The same from the environment itself."""
    reset, step, split = jax.jit(environment.reset), jax.jit(environment.step), jax.jit(jax.random.split)

    def start(key):
        key, key_start = split(key)
        state, observation = reset(key_start, params)
        return key, state, np.asarray(observation)

    key, state, observation = start(jax.random.key(int(seeding.np_random(seed)[0].integers(2**31))))
    rows = [observation]
    for action in actions:
        key, key_step = split(key)
        after = jax.device_get(step(key_step, state, action, params))
        state = after.state
        rows.append((after.observation, after.reward, after.terminated, after.truncated, *after.events))
        if after.terminated or after.truncated:
            key, state, observation = start(key)
            rows.append(observation)
    return rows


def assert_equal_bit_by_bit(rows, others):
    numbers = lambda rows: np.concatenate([np.ravel(part) for row in rows for part in row])
    assert len(rows) == len(others)
    np.testing.assert_array_equal(numbers(rows), numbers(others))


@pytest.mark.parametrize("name", peps_envs.names())
def test_gymnasiums_checker_is_content(name):
    check_env(gymnasium.make(to_gymnasium.id_of(name)).unwrapped)


def test_ids_and_what_they_make():
    assert {"peps/NavD1-v0", "peps/NavD4-v0", "peps/HighwayRain-v0"} <= set(gymnasium.registry)
    task = peps_envs.make("nav-d4")
    true, believed = (gymnasium.make("peps/NavD4-v0", belief=belief).unwrapped.params for belief in (None, "biased"))
    assert jax.tree.all(jax.tree.map(np.array_equal, true, task.params))
    assert jax.tree.all(jax.tree.map(np.array_equal, believed, task.beliefs["biased"]))
    with pytest.raises(ValueError, match=r"^belief 'baised' is unknown: did you mean 'biased'\? known are "):
        gymnasium.make("peps/NavD4-v0", belief="baised")


def test_a_task_that_is_registered_later_gets_an_id(monkeypatch):
    monkeypatch.setattr(registry, "_TASKS", dict(registry._TASKS))
    monkeypatch.setattr(gymnasium.envs.registration, "registry", gymnasium.registry)
    peps_envs.register("slow-walk", lambda: peps_envs.Task(Walk(), Track(pace=0.1), {"true": Track(pace=0.1)}))
    to_gymnasium.register_ids()
    env = gymnasium.make("peps/SlowWalk-v0")
    check_env(env.unwrapped)
    assert env.unwrapped.metadata["render_modes"] == []
    del gymnasium.registry["peps/SlowWalk-v0"]


@pytest.mark.parametrize(
    ("name", "steps"),
    [
        ("nav-d3", 1_000),
        ("highway-rain", 300),
        pytest.param("nav-d3", 20_000, marks=pytest.mark.long),
        pytest.param("highway-rain", 20_000, marks=pytest.mark.long),
    ],
)
def test_random_steps_are_the_environments_bit_by_bit(name, steps):
    env = gymnasium.make(to_gymnasium.id_of(name)).unwrapped
    actions = [np.asarray(action, env.action_space.dtype) for action in actions_of(env, steps)]
    assert_equal_bit_by_bit(told(env, actions, 3), happened(env.environment, env.params, actions, 3))


def test_the_seed_decides_and_episodes_differ():
    env = GymnasiumEnvironment(*NOISY)
    actions = actions_of(env, 30)
    one, again, other = (told(env, actions, seed) for seed in (1, 1, 2))
    assert_equal_bit_by_bit(one, again)
    assert not np.array_equal(one[0], other[0])
    starts = [row for row in one if isinstance(row, np.ndarray)]
    assert len(np.unique(starts)) == len(starts) > 2


def test_an_end_and_a_time_limit_are_two_things():
    env = GymnasiumEnvironment(Walk(horizon=3), Track(pace=0.2))
    env.reset(seed=0)
    still, ahead = np.zeros(1, np.float32), np.ones(1, np.float32)
    ends = [env.step(still)[2:] for _ in range(3)]
    assert [end[:2] for end in ends] == [(False, False), (False, False), (False, True)]
    env.reset()
    env = GymnasiumEnvironment(Walk(horizon=5), Track(pace=0.2))
    env.reset(seed=0)
    ends = [env.step(ahead)[2:] for _ in range(5)]  # there in the last moment
    assert ends[-1] == (True, False, {"arrived": True})


# --- batches --------------------------------------------------------------------------------------------------------------


def test_the_environments_of_a_batch_do_what_they_would_do_alone():
    """An action that falls on a new episode's start doesn't count: alone, it is where `reset` is called."""
    envs = GymnasiumVectorEnvironment(*NOISY, num_envs=3)
    actions = actions_of(envs, 40)
    rows, (first, _) = [], envs.reset(seed=5)
    assert first in envs.observation_space
    for action in actions:
        rows.append(envs.step(action))
        assert rows[-1][0] in envs.observation_space
    for place in range(3):
        env, restart = GymnasiumEnvironment(*NOISY), False
        np.testing.assert_array_equal(env.reset(seed=5 + place)[0], first[place])
        for action, (observation, reward, terminated, truncated, infos) in zip(actions, rows, strict=True):
            assert infos["_arrived"][place] == (not restart)
            expected = (env.reset()[0], 0.0, False, False, {}) if restart else env.step(action[place])
            np.testing.assert_allclose(observation[place], expected[0], rtol=1e-5)
            np.testing.assert_allclose(reward[place], expected[1], rtol=1e-5)
            assert (terminated[place], truncated[place]) == expected[2:4]
            assert infos["arrived"][place] == expected[4].get("arrived", False)
            restart = terminated[place] or truncated[place]


def test_a_batch_may_start_anew_in_the_same_step():
    """The same episodes, without the steps that don't count."""
    env = GymnasiumEnvironment(*NOISY)
    envs = gymnasium.vector.SyncVectorEnv([lambda: env], autoreset_mode="SameStep")
    ours = GymnasiumVectorEnvironment(*NOISY, num_envs=1, autoreset_mode="SameStep")
    np.testing.assert_allclose(envs.reset(seed=2)[0], ours.reset(seed=2)[0], rtol=1e-5)
    for action in actions_of(envs, 40):
        *theirs, their_infos = envs.step(action)
        *mine, infos = ours.step(action)
        for their, my in zip(theirs, mine, strict=True):
            np.testing.assert_allclose(their, my, rtol=1e-5)
        over = theirs[2][0] or theirs[3][0]
        assert ("final_obs" in infos) == ("final_obs" in their_infos) == over
        if over:
            np.testing.assert_allclose(infos["final_obs"][0], their_infos["final_obs"][0], rtol=1e-5)
            assert infos["final_info"]["arrived"][0] == their_infos["final_info"]["arrived"][0]


def test_batches_by_id():
    envs = gymnasium.make_vec("peps/NavD1-v0", num_envs=2, render_mode="rgb_array")
    observations, _ = envs.reset(seed=[4, None])
    assert observations.shape == envs.observation_space.shape == (2, 10)
    assert envs.step(envs.action_space.sample())[1].shape == (2,)
    one, other = envs.render()
    assert one.shape == other.shape
    one, other = (gymnasium.make_vec("peps/HighwayRain-v0", num_envs=2) for _ in range(2))
    np.testing.assert_array_equal(one.reset(seed=1)[0], other.reset(seed=1)[0])
    np.testing.assert_array_equal(one.reset()[0], other.reset()[0])
    with pytest.raises(ValueError, match=r"^seed has 3 numbers: give one, or one for each of 2 environments$"):
        envs.reset(seed=[1, 2, 3])
    with pytest.raises(ValueError, match=r"^autoreset_mode 'Never': choose one of 'NextStep', 'SameStep'$"):
        gymnasium.make_vec("peps/NavD1-v0", num_envs=2, autoreset_mode="Never")


# --- pictures -------------------------------------------------------------------------------------------------------------


def test_a_picture_shows_the_scene():
    env = gymnasium.make("peps/NavD1-v0", render_mode="rgb_array")
    env.reset(seed=0)
    before = env.render()
    env.step(np.array([1.0, 0.0], np.float32))
    after = env.render()
    assert before.shape == after.shape == (480, 480, 3)
    assert np.any(before != after)
    assert gymnasium.make("peps/NavD1-v0").unwrapped.render() is None
    with pytest.raises(ValueError, match=r"^render_mode 'rgb_array': this environment has none$"):
        GymnasiumEnvironment(Walk(), Track(0.1), render_mode="rgb_array")


# --- agents ---------------------------------------------------------------------------------------------------------------


def test_an_agent_of_ours_acts_in_gymnasium(tiny):
    """It makes the episode there that it makes in an evaluation."""
    result = untrained(tiny)
    act = jax.jit(lambda observation: result.act(observation))
    env = gymnasium.make("peps/NavD1-v0")
    observation, _ = env.reset(seed=0)
    total, over = 0.0, False
    while not over:
        observation, reward, terminated, truncated, _ = env.step(np.asarray(act(observation)))
        total, over = total + reward, terminated or truncated
    np.testing.assert_allclose(total, evaluate(result, 1).return_[0], rtol=1e-4)


@pytest.mark.long
def test_the_sac_of_stable_baselines3_learns_d1():
    sb3 = pytest.importorskip("stable_baselines3")
    torch = pytest.importorskip("torch")
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        env = gymnasium.make("peps/NavD1-v0")
        model = sb3.SAC("MlpPolicy", env, seed=0, learning_starts=1_000, learning_rate=1e-3, gamma=0.98,
                        batch_size=128, policy_kwargs={"net_arch": [64, 64]}, device="cpu")  # fmt: skip
        model.learn(4_000)
    finally:
        torch.set_num_threads(threads)
    observation, _ = env.reset(seed=1)
    total, over = 0.0, False
    while not over:
        observation, reward, terminated, truncated, info = env.step(model.predict(observation, deterministic=True)[0])
        total, over = total + reward, terminated or truncated
    assert info["goal_reached"]
    assert total > 80
