"""Which pairs people see.

On the dry road, those of the driving study: both pieces of a pair begin at the same moment of scenes that start alike, and most
drivers handle the scene on purpose. Elsewhere, routes that start alike and part: what is done is held for a while, then
something else. In navigation that is mostly one side's direction and then the other's, so that whole ways to the goal, and past
it, are among them. Pairs that were cut anywhere from random behaviour told nothing.
"""

from __future__ import annotations

import io
import json
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from peps_envs import Environment
from peps_envs.highway.vehicle import IDLE, SLOWER
from peps_envs.navigation import Navigation
from peps_jax import generator, rollout
from peps_jax.config import Config, Problem
from peps_jax.human_study import clips
from peps_jax.human_study.database.records import Stimulus
from peps_jax.preferences.data import Segments
from peps_jax.reproduce.driving import comparisons
from peps_jax.reproduce.driving.scenes import DRY, RAIN, crashed, road, watch, whole
from peps_jax.settings import RolloutSettings
from peps_jax.storage import files

LONGEST, SHORTEST = 20, 3  # steps of a piece of a route
SPARE = 4  # pairs that are made for each that is shown: in some somebody crashes, or a route ends before it parts
HOLDS = 3  # things that are done on a route, one after the other
STRAIGHT = 0.75  # of navigation's routes that go along one axis and then the other; the others go in random directions
SCATTER = 0.3  # of a direction along an axis


def problem(env: str) -> Problem:
    """Environment and parameters by name; on a road, with the driving study's scene. Raises ValueError."""
    return (road(env) if is_road(env) else Config(env=env)).problem()


def is_road(env: str) -> bool:
    """Whether the driving study takes place there."""
    return env in (DRY, RAIN)


# --- which pairs --------------------------------------------------------------------------------------------------------------


def to_ask(env: str, seed: int, number: int) -> Segments:
    """`number` pairs for the training phase: numpy arrays, (number, 2, steps, ...)."""
    key_drive, key_cut = jax.random.split(jax.random.fold_in(generator.key(seed), 1))
    if env == DRY:  # where the driving study's participants compare
        made = _cut_drives(_drive(key_drive, SPARE * number), key_cut)
        unfit = jnp.any(crashed(made), -1) | (_shortest(made) < comparisons.SHORTEST)
    else:
        made = _cut_routes(*routes(key_drive, problem(env), SPARE * number), key_cut)
        unfit = _shortest(made) < SHORTEST
    chosen = np.argsort(np.asarray(unfit), kind="stable")[:number]
    return jax.tree.map(lambda rows: np.asarray(rows)[chosen], made)


_drive = jax.jit(comparisons.drive, static_argnums=1)
_cut_drives = jax.jit(lambda scenes, key: comparisons.cut(key, scenes))


def _shortest(pairs: Segments) -> Array:
    return jnp.min(jnp.sum(pairs.mask, -1), -1)


def to_check(env: str, seed: int, number: int) -> Segments | None:
    """`number` pairs of which the first is plainly better: on the dry road, braking against a collision. None elsewhere.

    Raises:
      ValueError: there is no collision in one of them.
    """
    if env != DRY or not number:
        return None
    key = jax.random.fold_in(generator.key(seed), 2)
    keep = lambda action: lambda observation, key, time: jnp.full(number, action)
    shown = jax.jit(lambda action, task: watch(keep(action), task, key, number))
    sides = [shown(action, road(DRY).problem()) for action in (SLOWER, IDLE)]
    pairs = jax.tree.map(lambda *rows: np.stack(rows, 1), *sides)
    first, second = np.asarray(crashed(pairs)).T
    if np.any(first) or not np.all(second):
        raise ValueError(f"seed {seed} makes checks without a collision on one side only: choose another one")
    return pairs


def routes(key: Array, task: Problem, number: int) -> tuple[Segments, Array]:
    """Two routes each from one start, (number, 2, steps, ...), and the step at which they part, (number,)."""
    key_start, key_same, key_own, key_part, key_steps = jax.random.split(key, 5)
    length = min(2 * LONGEST, task.environment.horizon)
    settings = lambda number: RolloutSettings(number, length, hold_steps=1, exploration=jnp.zeros((), jnp.float32))
    twice = lambda tree: jax.tree.map(lambda rows: jnp.repeat(rows, 2, 0), tree)
    same, own = (held(key, task.environment, many, length) for key, many in ((key_same, number), (key_own, 2 * number)))
    part = jnp.where(jnp.arange(number) % 2 == 0, 0, jax.random.randint(key_part, (number,), 0, length // 2))
    time, parted = jnp.arange(length)[None], twice(part)[:, None]
    own = jnp.take_along_axis(own, _beside(jnp.maximum(time - parted, 0), own), 1)
    plan = jnp.where(_beside(time < parted, own), twice(same), own)
    act = lambda observation, key, time: plan[:, time]
    starts = twice(rollout.init(key_start, task, settings(number)))
    collect = jax.jit(lambda starts: rollout.collect(starts, act, key_steps, task, settings(2 * number))[1])
    return jax.tree.map(lambda rows: rows.reshape(number, 2, *rows.shape[1:]), whole(collect(starts))), part


def held(key: Array, environment: Environment, number: int, length: int) -> Array:
    """What is done on `number` routes: actions (number, length, ...), `HOLDS` of them one after the other."""
    key_action, key_axis, key_kind, key_until = jax.random.split(key, 4)
    draw = jax.vmap(jax.vmap(lambda key: rollout.random_action(environment.action_space, key)))
    action = draw(jax.random.split(key_action, (number, HOLDS)))
    if isinstance(environment, Navigation):
        axis = (jax.random.bernoulli(key_axis, shape=(number, 1)) + jnp.arange(HOLDS)[None]) % 2
        straight = jnp.eye(2)[axis] + SCATTER * action
        action = jnp.where(jax.random.bernoulli(key_kind, STRAIGHT, (number, 1, 1)), straight, action)
        action = jnp.clip(action, -1.0, 1.0)
    until = jnp.sort(jax.random.randint(key_until, (number, HOLDS - 1, 1), 1, length), 1)
    turn = jnp.sum(jnp.arange(length)[None, None] >= until, 1)  # (number, length)
    return jnp.take_along_axis(action, _beside(turn, action), 1)


def _beside(rows: Array, other: Array) -> Array:
    """`rows` (n, length) with as many axes as `other`."""
    return rows.reshape(*rows.shape, *[1] * (other.ndim - rows.ndim))


def _cut_routes(routes: Segments, part: Array, key: Array) -> Segments:
    """A piece of each of two routes, from where they part; the pieces of every other pair are equally long."""
    number, _, steps = routes.mask.shape
    most = min(LONGEST, steps)
    length = jax.random.randint(key, (number, 2, 1), SHORTEST, most + 1)
    length = jnp.where((jnp.arange(number) // 2 % 2 == 0)[:, None, None], length[:, :1], length)
    offset = jnp.arange(most)[None, None]
    place = part[:, None, None] + offset + jnp.zeros((1, 2, 1), int)
    take = lambda rows: jax.vmap(jax.vmap(lambda row, place: row[jnp.minimum(place, steps - 1)]))(rows, place)
    piece = jax.tree.map(take, routes)
    return piece._replace(mask=piece.mask & (offset < length) & (place < steps))


# --- what is kept of them ---------------------------------------------------------------------------------------------------


def pairs_of(task: Problem, segments: Segments) -> list[Stimulus]:
    """Pairs (n, 2, steps, ...) as the database keeps them and the pages draw them."""
    return [_stimulus(task, pair, (0, 1)) for pair in _each(segments)]


def scenes_of(task: Problem, scenes: Segments) -> list[Stimulus]:
    """Whole scenes (n, steps, ...), likewise."""
    return [_stimulus(task, scene, (None,)) for scene in _each(scenes)]


def segments_of(task: Problem, stimuli: Sequence[Stimulus]) -> Segments:
    """The segments that `pairs_of` or `scenes_of` was given, (n, ...). Raises ValueError if one has changed since."""
    structure = jax.tree.structure(_like(task))
    rows = []
    for one in stimuli:
        with np.load(io.BytesIO(one.arrays)) as file:
            arrays = dict(file)
        if _digest(arrays) != one.digest:
            raise ValueError(f"the arrays with the digest {one.digest[:8]} have changed since")
        rows.append(jax.tree.unflatten(structure, [arrays[name] for name in _names(len(arrays))]))
    return jax.tree.map(lambda *leaves: np.stack(leaves), *rows)


def _each(segments: Segments) -> list[Segments]:
    segments = jax.tree.map(np.asarray, segments._replace(worth=None))  # what people are shown, and nothing else
    at = lambda place: jax.tree.map(lambda rows: rows[place], segments)
    return list(map(at, range(len(segments.mask))))


def _stimulus(task: Problem, segments: Segments, sides: Sequence[int | None]) -> Stimulus:
    leaves = jax.tree.leaves(segments)
    arrays = dict(zip(_names(len(leaves)), leaves, strict=True))
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)
    side = lambda tree, which: tree if which is None else jax.tree.map(lambda rows: rows[which], tree)
    drawn = lambda one: clips.encode(task.environment, task.params, one.state, one.next_state, one.mask)
    drawings = tuple(_compact(drawn(side(segments, which))) for which in sides)
    return Stimulus(_digest(arrays), buffer.getvalue(), drawings)


def _like(task: Problem) -> Segments:
    state = jax.eval_shape(lambda: task.environment.reset(jax.random.key(0), task.params)[0])
    return Segments(0, 0, 0, 0, state, state)


def _names(number: int) -> list[str]:
    return [f"leaf{place}" for place in range(number)]


def _digest(arrays: Mapping[str, np.ndarray]) -> str:
    told = [(name, str(array.dtype), array.shape, files.digest(array.tobytes())) for name, array in arrays.items()]
    return files.json_digest(told)


def _compact(value: Any) -> str:
    return json.dumps(value, separators=(",", ":"), allow_nan=False)
