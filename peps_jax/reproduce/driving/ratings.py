"""Ratings of scenes from 1 to 10, by what each participant believes and wants, and their analysis of variance."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from peps_jax import explicability
from peps_jax.config import Problem
from peps_jax.preferences.data import Segments
from peps_jax.reproduce.driving.participants import Participants, attentive, mind, recruit

RATERS, SHOWN = 15, 3  # participants who rate, and scenes of each method that they see
GROUPS = 100  # of raters, re-drawn


def worth(participant: Participants, scenes: Segments, problem: Problem) -> Array:
    """(n,) explicability of `scenes` (n, horizon, ...) to one participant: sum r_H + sum (l_H - l_A) by their own belief."""
    own = problem.replace(belief=mind(participant, problem.params))
    score = lambda *transition: explicability.score(own, *transition)
    scores = jax.vmap(jax.vmap(score))(scenes.state, scenes.action, scenes.next_state)
    return jnp.sum(jnp.where(scenes.mask, scores.explicability, 0.0), -1)


def rate(key: Array, participants: Participants, scenes: Segments, problem: Problem) -> Array:
    """(participants, n) ratings from 1 to 10 of `scenes` (n, horizon, ...), which each participant has seen all of.

    rating_i = 1 + 9 mean_j sigmoid(rationality (E_i - E_j)): how often they would prefer the scene to another one that they
    saw, by their own Eq. (2). On the form it gets noise of standard deviation 1 and is a whole number.
    """

    def one(key: Array, participant: Participants) -> Array:
        value = worth(participant, scenes, problem)
        wins = jax.nn.sigmoid(participant.rationality * (value[:, None] - value[None]))
        felt = 1 + 9 * jnp.mean(wins, 1) + jax.random.normal(key, value.shape)
        return jnp.clip(jnp.round(felt), 1.0, 10.0)

    return jax.lax.map(lambda row: one(*row), (jax.random.split(key, participants.rationality.shape[0]), participants))


class Group(NamedTuple):
    """What one group of raters said."""

    mean: dict[str, float]  # by method, over raters
    sd: dict[str, float]
    p: float  # of a one-way ANOVA over the raters' means
    eta_squared: float  # share of the variance that lies between methods


def analyse(ratings: dict[str, np.ndarray]) -> Group:
    """One-way ANOVA of each rater's mean rating, (raters,) for each method."""
    from scipy import stats

    values = list(ratings.values())
    together = np.concatenate(values)
    between = sum(len(one) * (np.mean(one) - np.mean(together)) ** 2 for one in values)
    return Group(
        mean={method: float(np.mean(one)) for method, one in ratings.items()},
        sd={method: float(np.std(one, ddof=1)) for method, one in ratings.items()},
        p=float(stats.f_oneway(*values).pvalue),
        eta_squared=float(between / np.sum((together - np.mean(together)) ** 2)),
    )


def groups(key: Array, scenes: dict[str, Segments], problem: Problem, number: int = GROUPS) -> list[Group]:
    """`number` re-drawn groups of RATERS who passed the sanity check; each is shown SHOWN scenes of each method, drawn anew."""
    together = jax.tree.map(lambda *rows: jnp.stack(rows), *scenes.values())  # (methods, n, horizon, ...)
    ratings = np.asarray(_groups(jax.random.split(key, number), together, problem))
    return [analyse(dict(zip(scenes, group.T, strict=True))) for group in ratings]


@jax.jit
def _groups(keys: Array, scenes: Segments, problem: Problem) -> Array:
    """Mean ratings (groups, RATERS, methods) of `scenes` (methods, n, horizon, ...)."""
    methods, pool = scenes.mask.shape[:2]

    def one(key: Array) -> Array:
        key_recruit, key_check, key_show, key_rate = jax.random.split(key, 4)
        volunteers = recruit(key_recruit, 2 * RATERS)
        failed = ~attentive(key_check, volunteers)
        order = jnp.argsort(failed, stable=True)[:RATERS]
        raters = jax.tree.map(lambda rows: rows[order], volunteers)
        shown = jax.random.randint(key_show, (methods, SHOWN), 0, pool)
        drawn = jax.tree.map(lambda rows: jax.vmap(lambda row, which: row[which])(rows, shown), scenes)
        flat = jax.tree.map(lambda rows: rows.reshape(-1, *rows.shape[2:]), drawn)
        return rate(key_rate, raters, flat, problem).reshape(RATERS, methods, SHOWN).mean(-1)

    return jax.lax.map(one, keys)
