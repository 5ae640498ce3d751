"""Teachers: who answers queries. The synthetic human answers from a biased belief, by the paper's Eq. (2).

P(segment 1 preferred) = sigmoid(rationality * (Z_1 - Z_2)),    Z = sum_t myopia^(end - t) (l_H(s'|s,a) + r_H(s,a,s')),

with l_H the belief's log-density against the perceptual kernel. Mistakes, ties, skipping and myopia are those of B-Pref
(Lee et al. 2021, "B-Pref: Benchmarking Preference-Based Reinforcement Learning").
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

import peps_envs
from peps_jax.config import Config
from peps_jax.trajectory import Preferences, Segments


class Teacher(NamedTuple):
    """Who answers. `answer(key, segments, config) -> Preferences`; a person's answers come in as this same value."""

    answer: Callable[[Array, Segments, Config], Preferences]


def log_weight(
    environment: peps_envs.Environment, belief: Any, state: Any, action: Array, next_state: Any
) -> tuple[Array, Array]:
    """The exponents of Eq. (2) for one transition: l_H(s'|s,a) and r_H(s,a,s'), both ()."""
    expected = environment.next_state_distribution(state, action, belief)
    return (
        expected.relative_log_prob(environment.perceive(next_state)),
        environment.reward(state, action, next_state, belief),
    )


def segment_values(segments: Segments, config: Config) -> Array:
    """Z of Eq. (2) for each segment, (...): what the human thinks of it, with its end weighed more if it is myopic."""
    environment, _, belief = config.task()
    score = lambda state, action, next_state: sum(log_weight(environment, belief, state, action, next_state))
    for _ in segments.mask.shape:
        score = jax.vmap(score)
    values = score(segments.state, segments.action, segments.next_state)
    steps_to_end = jnp.sum(segments.mask, -1, keepdims=True) - jnp.cumsum(segments.mask, -1)
    return jnp.sum(values * segments.mask * config.myopia ** jnp.maximum(steps_to_end, 0.0), -1)


def answer(key: Array, segments: Segments, config: Config) -> Preferences:
    """The synthetic human's answers to queries `segments` (queries, 2, steps, ...)."""
    key_choice, key_mistake = jax.random.split(key)
    values = segment_values(segments, config)
    difference = values[:, 0] - values[:, 1]
    first = jax.random.uniform(key_choice, difference.shape) < jax.nn.sigmoid(config.rationality * difference)
    mistaken = jax.random.uniform(key_mistake, difference.shape) < config.mistake_rate
    choice = jnp.where(first ^ mistaken, 1.0, 0.0)
    return Preferences(
        segments=segments,
        answers=jnp.where(jnp.abs(difference) < config.indifference, 0.5, choice),
        answered=jnp.where(jnp.max(values, -1) < config.skip_below, 0.0, 1.0),
    )


SYNTHETIC = Teacher(answer=answer)
