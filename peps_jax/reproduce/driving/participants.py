"""Who takes part: what participants believe and want, what they prefer, and the sanity check."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import struct
from jax import Array

import peps_envs
from peps_envs.highway.environment import HighwayParams, Ratings
from peps_envs.highway.vehicle import IDLE, SLOWER
from peps_jax.config import Problem
from peps_jax.preferences import synthetic_human
from peps_jax.preferences.data import Answers, Queries, Segments
from peps_jax.reproduce.driving.scenes import DRY, road, watch
from peps_jax.settings import HumanSettings

CARELESS = 0.1  # share of participants who answer at random
# Pairs of the sanity check. A coin passes one with a probability of a half, and a single participant of 15 who answers at
# random halves the r-hat that fits all answers: certain preferences can't be 3 % wrong.
CHECKS = 5


@struct.dataclass
class Participants:
    """What each believes, wants, and how reliably they answer; every leaf has a leading axis of participants."""

    ratings: Ratings  # importance, 1 to 5
    lane_change_cost: Array
    swerve_cost: Array
    dry_share: Array  # of the way from the road's true friction to a dry one's that is believed: 1 is the paper's bias
    rationality: Array  # coefficient of Eq. (2), 0 of who answers at random


def recruit(key: Array, number: int) -> Participants:
    """`number` participants, scattered around the presets' human.

    Importance is rated on a 5-point scale around the paper's means with a standard deviation of 0.8; costs are log-normal;
    how dry the road is taken for is triangular on [0, 1] with its peak at 1.
    """
    key_ratings, key_costs, key_dry, key_rationality, key_careless = jax.random.split(key, 5)
    task = peps_envs.make(DRY)
    mean, want = jnp.stack(jax.tree.leaves(task.params.ratings)), task.beliefs["reward"]
    scores = jnp.clip(mean[:, None] + 0.8 * jax.random.normal(key_ratings, (mean.shape[0], number)), 1.0, 5.0)
    timidity = jnp.exp(0.3 * jax.random.normal(key_costs, (number,)))
    careless = jax.random.bernoulli(key_careless, CARELESS, (number,))
    rationality = 2.0 * jnp.exp(0.3 * jax.random.normal(key_rationality, (number,)))
    return Participants(
        ratings=jax.tree.unflatten(jax.tree.structure(task.params.ratings), list(scores)),
        lane_change_cost=want.lane_change_cost * timidity,
        swerve_cost=want.swerve_cost * timidity,
        dry_share=jnp.sqrt(jax.random.uniform(key_dry, (number,))),
        rationality=jnp.where(careless, 0.0, rationality),
    )


def mind(participant: Participants, params: HighwayParams) -> HighwayParams:
    """The belief of one participant about the road `params`."""
    dry, friction = peps_envs.make(DRY).params.physics.friction, params.physics.friction
    believed = jax.tree.map(lambda true, dry: true + participant.dry_share * (dry - true), friction, dry)
    return params.replace(
        physics=params.physics.replace(friction=believed),
        ratings=participant.ratings,
        lane_change_cost=participant.lane_change_cost,
        swerve_cost=participant.swerve_cost,
    )


def answers(key: Array, participants: Participants, segments: Segments, problem: Problem) -> Answers:
    """Each participant's answers to pairs of their own, numbered from 0 on: rows (participants, pairs)."""

    def one(key: Array, participant: Participants, segments: Segments) -> Answers:
        number = jnp.arange(segments.mask.shape[0], dtype=jnp.int32)
        own = problem.replace(belief=mind(participant, problem.params))
        return synthetic_human.answer(key, Queries(number, segments), own, manner(participant))

    return jax.vmap(one)(jax.random.split(key, participants.rationality.shape[0]), participants, segments)


def manner(participant: Participants) -> HumanSettings:
    """How a participant answers: by Eq. (2), as reliably as they are, and always."""
    number = lambda value: jnp.asarray(value, jnp.float32)
    return HumanSettings(
        rationality=participant.rationality,
        myopia=number(1.0),
        informed=number(0.0),
        mistake_rate=number(0.0),
        indifference=number(0.0),
        skip_below=number(-jnp.inf),
    )


def attentive(key: Array, participants: Participants) -> Array:
    """(participants,) bool: the sanity check, CHECKS pairs on a dry road. Who ever prefers a collision to braking fails."""
    problem = road(DRY).problem()
    plans = [lambda observation, key, time, action=action: jnp.full(CHECKS, action) for action in (SLOWER, IDLE)]
    pairs = jax.tree.map(lambda *rows: jnp.stack(rows, 1), *(watch(plan, problem, key, CHECKS) for plan in plans))
    number = participants.rationality.shape[0]
    shown = jax.tree.map(lambda rows: jnp.broadcast_to(rows, (number, *rows.shape)), pairs)
    return jnp.all(answers(key, participants, shown, problem).preferred == 1.0, 1)
