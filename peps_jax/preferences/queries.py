"""Queries: which pairs of segments the teacher is asked to compare.

Candidates are cut from the latest trajectories. The information that an answer brings about r-hat is the mutual information
between the answer and the ensemble's members (Biyik et al. 2019),

    gain = H(mean_k p_k) - mean_k H(p_k),    p_k = P(first preferred) by member k,

0 where the members agree and at most log 2. Of the most informative candidates a varied batch is taken.
"""

from __future__ import annotations

import chex
import jax
import jax.numpy as jnp
from jax import Array

from peps_jax.preferences.data import Segments
from peps_jax.settings import QuerySettings
from peps_jax.trajectory import Trajectory


def candidates(trajectory: Trajectory, key: Array, settings: QuerySettings) -> Segments:
    """Pairs of segments from `trajectory` (steps, num_envs, ...): (per_round * candidates_per_query, 2, steps, ...).

    Starts and watched environments are uniform, lengths uniform from `min_segment_length` to `segment_length`; a segment ends
    earlier where its episode does.
    """
    steps, watched_envs = trajectory.worth.shape[:2]
    shape = (settings.per_round * settings.candidates_per_query, 2)
    first = jnp.array([0, 0, settings.min_segment_length], jnp.int32)
    beyond = jnp.array([watched_envs, steps - settings.segment_length + 1, settings.segment_length + 1], jnp.int32)
    # `generator.integers` would be compiled into every gather below, which nearly doubles a training's compilation
    draw = lambda key, first, beyond: jax.random.randint(key, shape, first, beyond, jnp.int32)
    env, start, length = jax.vmap(draw)(jax.random.split(key, 3), first, beyond)[..., None]  # compiled once
    offset = jnp.arange(settings.segment_length)[None, None]
    cut = jax.tree.map(lambda rows: rows[start + offset, env], trajectory)
    over = cut.transition.terminated | cut.truncated
    ended_before = jnp.cumsum(over, -1) - over > 0
    return Segments(
        observation=cut.transition.observation,
        action=cut.transition.action,
        mask=(offset < length) & ~ended_before,
        reward=cut.transition.reward,
        state=cut.state,
        next_state=cut.next_state,
        worth=cut.worth,
    )


def _binary_entropy(probability: Array) -> Array:
    return -jax.scipy.special.xlogy(probability, probability) - jax.scipy.special.xlog1py(1 - probability, -probability)


def information_gain(logits: Array) -> Array:
    """Mutual information, in nats, between the answer and the member: (n,) from the members' logits (members, n)."""
    probability = jax.nn.sigmoid(logits)
    return jnp.maximum(_binary_entropy(jnp.mean(probability, 0)) - jnp.mean(_binary_entropy(probability), 0), 0.0)


def disagreement(logits: Array) -> Array:
    """Variance of the members' probabilities (Christiano et al. 2017): (n,) from logits (members, n)."""
    return jnp.var(jax.nn.sigmoid(logits), 0)


def choose(logits: Array, descriptions: Array, key: Array, settings: QuerySettings) -> Array:
    """Indices (per_round,) of the candidates to ask, best first: none twice, and near-duplicates last.

    Args:
      logits: (members, candidates) of the first segment being preferred.
      descriptions: (candidates, n) of each pair; a pair near an already chosen one counts for less,
        1 - exp(-(distance / typical distance)^2). Between equals, all of no worth for example, chance decides.
    """
    chex.assert_equal(logits.shape[1], descriptions.shape[0])
    score = {
        "information_gain": lambda: information_gain(logits) + 1e-9,
        "disagreement": lambda: disagreement(logits) + 1e-9,
        "random": lambda: jax.random.uniform(key, logits.shape[1:], jnp.float32, minval=1e-3),
    }[settings.strategy]()
    luck = jax.random.uniform(jax.random.fold_in(key, 1), score.shape, jnp.float32)
    # mean squared distance of two candidates
    typical = 2 * jnp.mean(jnp.var(descriptions, 0)) * descriptions.shape[1] + 1e-6

    def take(carry: tuple[Array, Array], _: None) -> tuple[tuple[Array, Array], Array]:
        score, free = carry
        offered = jnp.where(free, score, -1.0)
        best = jnp.argmax(jnp.where(offered == jnp.max(offered), luck, -1.0)).astype(jnp.int32)
        squared = jnp.sum((descriptions - descriptions[best][None]) ** 2, -1)
        # a tenth of the typical distance counts as near
        score = score * -jnp.expm1(-100 * squared / typical)
        return (score, free & (jnp.arange(score.shape[0]) != best)), best

    _, chosen = jax.lax.scan(take, (score, jnp.ones(score.shape, bool)), None, settings.per_round)
    return chosen


def describe(segments: Segments) -> Array:
    """(candidates, n): where each of a pair's segments begins and ends, and how long it is; what `choose` compares."""
    length = jnp.sum(segments.mask, -1)
    last = jnp.maximum(length - 1, 0).astype(jnp.int32)
    ends = jnp.take_along_axis(segments.observation, last[..., None, None], -2)[..., 0, :]
    share = (length / segments.mask.shape[-1]).astype(jnp.float32)
    parts = jnp.concatenate([segments.observation[..., 0, :], ends, share[..., None]], -1)
    return parts.reshape(parts.shape[0], -1)
