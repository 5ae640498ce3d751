"""The synthetic human, who answers from a biased belief, by the paper's Eq. (2).

P(segment 1 preferred) = sigmoid(rationality * (Z_1 - Z_2)),    Z = sum_t myopia^(end - t) (l_H(s'|s,a) + r_H(s,a,s')),

with l_H the belief's log-density against the perceptual kernel. Mistakes, ties, skipping and myopia are those of B-Pref
(Lee et al. 2021, "B-Pref: Benchmarking Preference-Based Reinforcement Learning").
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

import peps_envs
from peps_envs.environment import side_by_side
from peps_jax.config import Problem
from peps_jax.preferences.data import Answers, Queries, Segments
from peps_jax.settings import HumanSettings


def log_weight(
    environment: peps_envs.Environment, belief: Any, state: Any, action: Array, next_state: Any
) -> tuple[Array, Array]:
    """The exponents of Eq. (2) for one transition: l_H(s'|s,a) and r_H(s,a,s'), both ()."""
    expected = environment.next_state_distribution(state, action, belief)
    return (
        expected.relative_log_prob(environment.perceive(next_state)),
        environment.reward(state, action, next_state, belief),
    )


def judge(segments: Segments, problem: Problem) -> Array:
    """(..., steps, 2) l + r of each step, by the problem's belief and by the truth."""
    beliefs = side_by_side(problem.belief, problem.params)  # both at once: one density in the program

    def score(state: Any, action: Array, next_state: Any) -> Array:
        return jax.vmap(lambda belief: sum(log_weight(problem.environment, belief, state, action, next_state)))(beliefs)

    for _ in segments.mask.shape:
        score = jax.vmap(score)
    return score(segments.state, segments.action, segments.next_state)


def segment_values(segments: Segments, problem: Problem, settings: HumanSettings) -> Array:
    """Z of Eq. (2) for each segment, (..., 2): what who has the belief, and who knows the truth, think of it.

    Its end is weighed more if they are myopic. Steps that were judged when they were made, by the problem's belief, aren't again.
    """
    values = judge(segments, problem) if segments.worth is None else segments.worth
    shown = jnp.where(segments.mask, 1.0, 0.0).astype(jnp.float32)
    steps_to_end = jnp.sum(shown, -1, keepdims=True) - jnp.cumsum(shown, -1)
    weight = settings.myopia ** jnp.maximum(steps_to_end, 0.0)
    return jnp.sum(jnp.where(segments.mask[..., None], values, 0.0) * weight[..., None], -2).astype(jnp.float32)


def answer(key: Array, queries: Queries, problem: Problem, settings: HumanSettings) -> Answers:
    """The synthetic human's answers to `queries`."""
    keys = jnp.stack([jax.random.fold_in(key, 1), *jax.random.split(key)])
    draw = lambda key: jax.random.uniform(key, queries.number.shape, jnp.float32)
    of_knowing, of_choice, of_mistake = jax.vmap(draw)(keys)  # compiled once
    both = segment_values(queries.segments, problem, settings)  # (queries, 2, 2)
    knows = of_knowing < settings.informed
    values = jnp.where(knows[:, None], both[..., 1], both[..., 0])  # (queries, 2)
    difference = values[:, 0] - values[:, 1]
    first = of_choice < jax.nn.sigmoid(settings.rationality * difference)
    mistaken = of_mistake < settings.mistake_rate
    choice = jnp.where(first ^ mistaken, 1.0, 0.0)
    return Answers(
        number=queries.number,
        preferred=jnp.where(jnp.abs(difference) < settings.indifference, 0.5, choice),
        weight=jnp.where(jnp.max(values, -1) < settings.skip_below, 0.0, 1.0),
    )
