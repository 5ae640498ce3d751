"""The explicability metric, Definition 2 and Eq. (3)-(4), transition by transition.

Per episode, with undiscounted sums over its steps,

    explicability = sum r_H + sum (l_H - l_A),

where l_H and l_A are the log-densities of the perceived next state under the belief and under the true dynamics, relative to
the perceptual kernel. The whole of Eq. (4) also subtracts the policy's term sum l_pi, relative to the uniform policy.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import chex
import jax
import jax.numpy as jnp
from jax import Array

import peps_envs
from peps_jax.config import Problem
from peps_jax.preferences import synthetic_human


class Score(NamedTuple):
    """What a transition, or the sum over an episode, is worth to agent and human."""

    return_: Array  # sum r_A
    human_return: Array  # sum r_H
    log_belief: Array  # sum l_H
    log_true: Array  # sum l_A

    @property
    def belief_gap(self) -> Array:
        """sum (l_H - l_A): how much less the human expected what happened than the truth did."""
        return self.log_belief - self.log_true

    @property
    def explicability(self) -> Array:
        """sum r_H + sum (l_H - l_A)."""
        return self.human_return + self.belief_gap

    @property
    def worth(self) -> Array:
        """(..., 2) l_H + r_H and l_A + r_A: what who has the belief, and who knows the truth, think of it."""
        return jnp.stack([self.log_belief + self.human_return, self.log_true + self.return_], -1)


def judged_step(problem: Problem, key: Array, state: Any, action: Array) -> tuple[peps_envs.Step, Score, Array]:
    """One step of the true dynamics; its score, every field of which is () float32; and what the human imagines, as perceived."""
    after, judged = problem.environment.judged_step(key, state, action, problem.params, problem.belief)
    score = _score(after.reward, judged)
    chex.assert_shape(list(score), ())
    return after, score, judged.imagined


def judged_steps(
    problem: Problem, keys: Array, states: Any, actions: Array, watched: int
) -> tuple[peps_envs.Step, Score, Array]:
    """The same of n environments side by side (n, ...), of which the human watches the first: scores are (watched,)."""
    after, judged = problem.environment.judged_steps(keys, states, actions, problem.params, problem.belief, watched)
    chex.assert_shape([after.reward, after.terminated, after.truncated], actions.shape[:1])
    score = _score(after.reward[:watched], judged)
    chex.assert_shape(list(score), (watched,))
    return after, score, judged.imagined


def _score(reward: Array, judged: peps_envs.Judgement) -> Score:
    worth = (reward, judged.human_reward, judged.log_belief, judged.log_true)
    return Score(*(jnp.asarray(value, jnp.float32) for value in worth))


def score(problem: Problem, state: Any, action: Array, next_state: Any) -> Score:
    """The score of one transition that happened before; every field is () float32."""
    environment, params = problem.environment, problem.params
    log_belief, human_reward = synthetic_human.log_weight(environment, problem.belief, state, action, next_state)
    expected = environment.next_state_distribution(state, action, params)
    worth = Score(
        return_=environment.reward(state, action, next_state, params),
        human_return=human_reward,
        log_belief=log_belief,
        log_true=expected.relative_log_prob(environment.perceive(next_state)),
    )
    chex.assert_shape(list(worth), ())
    return Score(*(jnp.asarray(value, jnp.float32) for value in worth))


def episode_sums(values: Any, over: Array, running: Any) -> tuple[Any, Any]:
    """Sums since each episode's start.

    Args:
      values: pytree of (steps, n), one for each transition.
      over: (steps, n) bool, whether an episode ended with the transition.
      running: pytree of (n,), sums carried in from before.

    Returns:
      sums: pytree of (steps, n), which at the transitions where `over` holds are the episodes' totals.
      running: sums of the episodes that go on.
    """

    chex.assert_equal_shape([over, *jax.tree.leaves(values)])
    chex.assert_equal_shape([over[0], *jax.tree.leaves(running)])

    def add(running: Any, step: tuple[Any, Array]) -> tuple[Any, Any]:
        value, over = step
        total = jax.tree.map(jnp.add, running, value)
        return jax.tree.map(lambda sums: jnp.where(over, 0.0, sums), total), total

    running, sums = jax.lax.scan(add, running, (values, over))
    return sums, running
