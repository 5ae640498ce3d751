"""The metric of Definition 2, transition by transition and summed up."""

import jax
import jax.numpy as jnp
import numpy as np
from conftest import LineParams, Point

from peps_jax import explicability
from peps_jax.config import Problem
from peps_jax.explicability import Score


def test_score_of_a_transition_by_hand(line):
    params, belief = LineParams(noise=0.0, slope=1.0), LineParams(noise=0.3, slope=-2.0)
    state, after = Point(jnp.zeros(1), 0), Point(jnp.full(1, 0.17), 1)
    score = explicability.score(Problem(line.env, params, belief), state, jnp.ones(1), after)
    off = (0.17 - 0.1) ** 2
    np.testing.assert_allclose(score.return_, 0.17, rtol=1e-5)
    np.testing.assert_allclose(score.human_return, -0.34, rtol=1e-5)
    np.testing.assert_allclose(score.log_true, -0.5 * off / 0.1**2, rtol=1e-4)
    np.testing.assert_allclose(score.log_belief, -0.5 * off / 0.1 - 0.5 * np.log(0.1 / 0.1**2), rtol=1e-4)
    np.testing.assert_allclose(score.belief_gap, score.log_belief - score.log_true, rtol=1e-6)
    np.testing.assert_allclose(score.explicability, score.human_return + score.belief_gap, rtol=1e-6)


def test_a_perfect_prediction_scores_0(line):
    state, after = Point(jnp.zeros(1), 0), Point(jnp.full(1, 0.1), 1)
    score = explicability.score(Problem(line.env, line.params, line.params), state, jnp.ones(1), after)
    np.testing.assert_allclose([score.log_true, score.log_belief, score.belief_gap], 0.0, atol=1e-6)


def plain_sums(values, over, running):
    """The same with loops."""
    sums, running = np.zeros_like(values), running.copy()
    for step in range(values.shape[0]):
        for env in range(values.shape[1]):
            running[env] += values[step, env]
            sums[step, env] = running[env]
            if over[step, env]:
                running[env] = 0.0
    return sums, running


def test_episode_sums_against_a_plain_loop():
    random = np.random.default_rng(0)
    values = Score(*random.normal(size=(4, 30, 3)).astype(np.float32))
    over = random.random((30, 3)) < 0.2
    running = Score(*random.normal(size=(4, 3)).astype(np.float32))
    sums, rest = jax.jit(explicability.episode_sums)(values, over, running)
    for field in Score._fields:
        expected_sums, expected_rest = plain_sums(getattr(values, field), over, getattr(running, field))
        np.testing.assert_allclose(getattr(sums, field), expected_sums, rtol=1e-4, atol=1e-5)
        np.testing.assert_allclose(getattr(rest, field), expected_rest, rtol=1e-4, atol=1e-5)


def test_episode_sums_go_on_from_round_to_round():
    random = np.random.default_rng(1)
    values, over = random.normal(size=(20, 2)).astype(np.float32), random.random((20, 2)) < 0.1
    whole, end = explicability.episode_sums(values, over, jnp.zeros(2))
    first, between = explicability.episode_sums(values[:7], over[:7], jnp.zeros(2))
    second, rest = explicability.episode_sums(values[7:], over[7:], between)
    np.testing.assert_allclose(jnp.concatenate([first, second]), whole, atol=1e-5)
    np.testing.assert_allclose(rest, end, atol=1e-5)
