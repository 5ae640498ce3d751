"""The training group's comparisons: which pairs of pieces of scenes it sees on the dry road, and what it says of them.

The paper's authors chose the pairs by hand. Here both pieces of a pair begin at the same moment of scenes that start alike, and
most drivers handle the scene on purpose: they brake for a while, from not at all to the very end, and then change lane. Where
all drivers acted at random and pieces were cut anywhere, hardly a pair told braking first from steering at once, and r-hat's
difference between the two was no larger than its error. Some wait without braking: where late lane changes were all slow ones,
r-hat liked them for being late, and agents waited a second and then steered at full speed.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import Array

from peps_envs.highway import Highway
from peps_envs.highway.vehicle import LANE_LEFT, SLOWER
from peps_jax import rollout
from peps_jax.preferences.data import Answers, Segments
from peps_jax.reproduce.driving.participants import answers, attentive, recruit
from peps_jax.reproduce.driving.scenes import DRY, HORIZON, crashed, road, whole, whole_scenes

NUM_ACTIONS = Highway.action_space.size
TRAINERS, ANSWERS = 15, 200  # participants who compare, and how many pairs each of them
PURPOSEFUL = 0.8  # share of drivers who wait, most of them braking, and then change lane; the others act at random
BRAKING = 0.5  # share of those who brake meanwhile; the others hold any action, which tells late from slow lane changes
FROM_START = 0.8  # share of pairs that begin with the scene; the others begin anywhere
SAME_LENGTH = 0.5  # share of pairs whose pieces are equally long; the others' unequal lengths tell r-hat's level
SHORTEST = 2  # steps of a piece
SPARE = 4  # pairs that are made for each that is shown, because in some of them somebody crashes


def plans(key: Array, number: int) -> Array:
    """What `number` drivers do, (number, HORIZON).

    At random, each action held for one to four steps; or on purpose: one action, mostly braking, is held for a while, from not at
    all to the very end, then the lane is changed, and what follows is random again.
    """
    key_hold, key_action, key_until, key_first, key_brake, key_purpose = jax.random.split(key, 6)
    time, column = jnp.arange(HORIZON)[None], (number, 1)
    hold = jax.random.randint(key_hold, column, 1, 5)
    drawn = jax.random.randint(key_action, (number, HORIZON), 0, NUM_ACTIONS)
    random = jnp.take_along_axis(drawn, time // hold, 1)
    until = jax.random.randint(key_until, column, 0, HORIZON + 1)
    other = jax.random.randint(key_first, column, 0, NUM_ACTIONS)
    first = jnp.where(jax.random.bernoulli(key_brake, BRAKING, column), SLOWER, other)
    purposeful = jnp.where(time < until, first, jnp.where(time == until, LANE_LEFT, random))
    return jnp.where(jax.random.bernoulli(key_purpose, PURPOSEFUL, column), purposeful, random)


def drive(key: Array, number: int) -> Segments:
    """Whole scenes of two drivers each on the dry road, who start alike: (number, 2, HORIZON, ...)."""
    key_start, key_plan, key_steps = jax.random.split(key, 3)
    problem = road(DRY).problem()
    starts = rollout.init(key_start, problem, whole_scenes(number))
    actors = jax.tree.map(lambda rows: jnp.repeat(rows, 2, 0), starts)
    planned = plans(key_plan, 2 * number)
    act = lambda observation, key, time: planned[:, time]
    _, trajectory, _ = rollout.collect(actors, act, key_steps, problem, whole_scenes(2 * number))
    return jax.tree.map(lambda rows: rows.reshape(number, 2, *rows.shape[1:]), whole(trajectory))


def cut(key: Array, scenes: Segments) -> Segments:
    """A piece of each of `scenes` (n, 2, HORIZON, ...), from the same moment in both."""
    number = scenes.mask.shape[0]
    key_from, key_start, key_length, key_same = jax.random.split(key, 4)
    anywhere = jax.random.randint(key_start, (number, 1, 1), 0, HORIZON - SHORTEST + 1)
    start = jnp.where(jax.random.bernoulli(key_from, FROM_START, (number, 1, 1)), 0, anywhere)
    lengths = jax.random.randint(key_length, (number, 2, 1), SHORTEST, HORIZON + 1)
    length = jnp.where(jax.random.bernoulli(key_same, SAME_LENGTH, (number, 1, 1)), lengths[:, :1], lengths)
    offset = jnp.arange(HORIZON)[None, None]
    place = jnp.minimum(start + offset, HORIZON - 1) + jnp.zeros((1, 2, 1), int)
    one = lambda rows, place: rows[place]
    piece = jax.tree.map(lambda rows: jax.vmap(jax.vmap(one))(rows, place), scenes)
    shown = (offset < length) & (start + offset < HORIZON)
    return piece._replace(mask=shown & piece.mask)


def pairs_shown(key_drive: Array, key_cut: Array) -> Segments:
    """What the training group is shown: TRAINERS * ANSWERS pairs of pieces of scenes on the dry road, in none a collision."""
    number = TRAINERS * ANSWERS
    pairs = cut(key_cut, drive(key_drive, SPARE * number))
    empty = jnp.min(jnp.sum(pairs.mask, -1), -1) == 0  # begins after a crash
    safe = jnp.argsort(jnp.any(crashed(pairs), -1) | empty, stable=True)[:number]
    return jax.tree.map(lambda rows: rows[safe], pairs)


def compare(key: Array, each: Array | int = ANSWERS) -> tuple[Segments, Answers]:
    """The pairs that the training group is shown, and what it says of them. Who fails the sanity check doesn't count.

    Args:
      each: how many of its pairs each participant answers, at most `ANSWERS`; the others weigh nothing.
    """
    key_group, key_drive, key_cut, key_answer, key_check, _ = jax.random.split(key, 6)
    pairs = pairs_shown(key_drive, key_cut)
    shown = jax.tree.map(lambda rows: rows.reshape(TRAINERS, ANSWERS, *rows.shape[1:]), pairs)
    participants = recruit(key_group, TRAINERS)
    given = answers(key_answer, participants, shown, road(DRY).problem())
    passed = attentive(key_check, participants)
    flat = lambda rows: rows.reshape(-1)
    counts = passed[:, None] & (jnp.arange(ANSWERS) < each)[None]
    weight = jnp.where(counts, given.weight, 0.0)
    number = jnp.arange(TRAINERS * ANSWERS, dtype=jnp.int32)
    return pairs, Answers(number, flat(given.preferred), flat(weight))
