"""Evaluation: episodes of a policy and what they score."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import Line, LineParams

import peps_jax
from peps_jax import explicability
from peps_jax.config import Problem
from peps_jax.evaluate import evaluate_policy

EPISODES = 6


@pytest.fixture(scope="module")
def evaluate():
    return jax.jit(peps_jax.evaluate, static_argnames=("num_episodes", "stochastic"))


@pytest.fixture(scope="module")
def navigation(tiny, train, evaluate):
    """D1 with a hardly trained SAC policy that acts at random: the arrays of a real domain."""
    config = tiny.replace(method="sac")
    return evaluate(train(config), num_episodes=EPISODES, stochastic=True)


def constant(value, log_policy=0.0):
    """A policy that always does `value`."""
    return lambda observation, key: (jnp.full(1, value), jnp.asarray(log_policy))


# the policy is code, so every one of them is another program
line_episodes = functools.partial(jax.jit, static_argnums=0)(
    lambda policy, params, belief, key: evaluate_policy(policy, Problem(Line(), params, belief), key, EPISODES)
)


def test_arrays_are_one_entry_an_episode(navigation):
    for name in (
        "return_", "explicability", "explicability_with_policy", "belief_gap", "human_return", "log_belief", "log_true",
        "log_policy", "length", "goal_reached", "pit_reached",
    ):  # fmt: skip
        values = getattr(navigation, name)
        assert values.shape == (EPISODES,), name
        assert bool(jnp.all(jnp.isfinite(values))), name
    assert navigation.perceived.shape == (EPISODES, 201, 2)
    assert navigation.goal_reached.dtype == bool


def test_explicability_is_the_sum_of_its_parts(navigation):
    parts = navigation.human_return + navigation.log_belief - navigation.log_true
    np.testing.assert_allclose(navigation.explicability, parts, rtol=1e-5, atol=1e-3)
    np.testing.assert_allclose(navigation.belief_gap, navigation.log_belief - navigation.log_true, rtol=1e-5, atol=1e-3)
    whole = navigation.explicability - navigation.log_policy
    np.testing.assert_allclose(navigation.explicability_with_policy, whole, rtol=1e-6)
    np.testing.assert_allclose(navigation.return_, navigation.human_return, rtol=1e-5)  # r_H = r_A in this preset
    np.testing.assert_allclose(navigation.log_true, 0.0, atol=1e-3)  # D1 is deterministic


def test_events_are_attributes_and_others_an_error(navigation):
    over = navigation.goal_reached | navigation.pit_reached
    assert bool(jnp.all(over | (navigation.length == 200)))
    with pytest.raises(AttributeError, match=r"'flag_reached'.*goal_reached, pit_reached"):
        _ = navigation.flag_reached


def test_episodes_by_hand():
    params = LineParams()
    found = line_episodes(constant(1.0, log_policy=0.5), params, LineParams(noise=0.1), jax.random.key(0))
    start = np.asarray(found.perceived[:, 0, 0])
    for episode in range(EPISODES):
        places = []
        while len(places) < 8 and (not places or places[-1] <= 0.25):
            places.append(start[episode] + 0.1 * (len(places) + 1))
        np.testing.assert_allclose(found.return_[episode], sum(places), rtol=1e-4)
        assert int(found.length[episode]) == len(places)
        assert bool(found.arrived[episode]) == (places[-1] > 0.25)
        np.testing.assert_allclose(found.perceived[episode, len(places) :, 0], places[-1], rtol=1e-4)
        # every step is as predicted, by a human who expected noise as wide as the kernel
        np.testing.assert_allclose(found.belief_gap[episode], -0.5 * np.log(2) * len(places), rtol=1e-3)
        np.testing.assert_allclose(found.log_policy[episode], 0.5 * len(places), rtol=1e-5)


def test_time_runs_out():
    found = line_episodes(constant(0.0), LineParams(), LineParams(), jax.random.key(0))
    np.testing.assert_array_equal(found.length, 8)
    assert not bool(jnp.any(found.arrived))
    np.testing.assert_allclose(found.return_, 8 * found.perceived[:, 0, 0], rtol=1e-5)
    np.testing.assert_allclose(found.explicability, found.return_, rtol=1e-5)


def test_repeats_are_equal_and_other_keys_are_not(line, train, evaluate):
    result = train(line)
    one, two = (evaluate(result, num_episodes=EPISODES) for _ in range(2))
    jax.tree.map(np.testing.assert_array_equal, one, two)
    other = evaluate(result, num_episodes=EPISODES, key=jax.random.key(9))
    assert not np.array_equal(one.return_, other.return_)
    sampled = evaluate(result, num_episodes=EPISODES, stochastic=True)
    np.testing.assert_array_equal(one.perceived[:, 0], sampled.perceived[:, 0])
    assert not np.array_equal(one.return_, sampled.return_)


def test_evaluation_is_pure(line, train, evaluate):
    """Under vmap over keys, each one's episodes are those that it has alone."""
    result, keys = train(line), jax.random.split(jax.random.key(3), 2)
    batch = jax.jit(jax.vmap(lambda key: peps_jax.evaluate(result, EPISODES, key=key)))(keys)
    single = evaluate(result, num_episodes=EPISODES, key=keys[1])
    np.testing.assert_allclose(batch.explicability[1], single.explicability, rtol=1e-4, atol=1e-4)


def test_by_default_episodes_follow_from_the_trainings_seed(line, train, evaluate):
    """Under vmap over seeds, a run's episodes are those of the run alone."""
    result, configs = train(line), peps_jax.grid(line, seed=[0, 3])
    trained_by = lambda config: result.replace(training=result.training.replace(config=config))
    batch = jax.jit(jax.vmap(lambda config: peps_jax.evaluate(trained_by(config), EPISODES)))(configs)
    single = evaluate(trained_by(line.replace(seed=3)), num_episodes=EPISODES)
    np.testing.assert_allclose(batch.explicability[1], single.explicability, rtol=1e-4, atol=1e-4)
    assert not np.allclose(batch.perceived[0], batch.perceived[1])


def test_another_problem_is_acted_in_and_scored_by(line, train, evaluate):
    """A belief changes what the same episodes are worth to the human; other parameters change what happens."""
    result = train(line)
    own = evaluate(result, num_episodes=EPISODES)
    scored = lambda params, belief: evaluate(result, num_episodes=EPISODES, problem=Problem(line.env, params, belief))
    jax.tree.map(np.testing.assert_array_equal, scored(line.params, line.belief), own)
    other = scored(line.params, LineParams(noise=0.3, slope=-2.0))
    np.testing.assert_array_equal(other.perceived, own.perceived)
    np.testing.assert_array_equal(other.return_, own.return_)
    np.testing.assert_allclose(other.human_return, -2 * own.return_, rtol=1e-5)
    assert np.all(np.asarray(other.log_belief) < own.log_belief)
    paid = scored(LineParams(slope=3.0), line.belief)
    np.testing.assert_allclose(paid.return_, 3 * own.return_, rtol=1e-5)
    np.testing.assert_allclose(paid.human_return, own.human_return, rtol=1e-5)
    assert not np.allclose(scored(LineParams(noise=0.2), line.belief).perceived, own.perceived)


def test_collected_episodes_score_as_evaluated_ones(line):
    """An episode's score is the sum over its transitions."""
    environment, params = line.env, line.params
    found = line_episodes(constant(0.5), params, line.belief, jax.random.key(0))
    state, _ = environment.reset(jax.random.key(0), params)
    state = state.replace(place=found.perceived[0, 0])
    total = jax.tree.map(jnp.zeros_like, jax.tree.map(lambda values: values[0], found.score))
    for _ in range(int(found.length[0])):
        after = environment.step(jax.random.key(0), state, jnp.full(1, 0.5), params)
        score = explicability.score(line.problem(), state, jnp.full(1, 0.5), after.state)
        total, state = jax.tree.map(jnp.add, total, score), after.state
    for field, value in zip(total._fields, total, strict=True):
        np.testing.assert_allclose(getattr(found.score, field)[0], value, rtol=1e-4, atol=1e-5, err_msg=field)
