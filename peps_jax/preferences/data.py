"""Queries, answers, and the set that they fill: data with names, whoever answers.

A query has a number, its identity. Answers are filed under it: in any order, late, in part, several times (an answer is
weighed by how many people gave it), or never. A preference set has a fixed capacity, so that one program serves a training;
what a round asks is written to it as one slice, which under `vmap` stays a slice.
"""

from __future__ import annotations

import io
import zipfile
from pathlib import Path
from typing import Any, NamedTuple

import chex
import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array

from peps_envs import ActionSpace, Discrete
from peps_jax.fields import MOST
from peps_jax.storage import files

NOBODY = -1  # the number of a place without a query
FORMAT = 2  # of a file; another one isn't read


class Segments(NamedTuple):
    """Pieces of trajectories, padded to one length. Two along the axis before `steps` make a query."""

    observation: Array  # (..., steps, observation_size)
    action: Array  # (..., steps, action_size) or (..., steps)
    mask: Array  # (..., steps) bool: True where the segment goes on, False after its end
    reward: Array  # (..., steps) r_A, that the agent observed
    state: Any  # (..., steps, ...) the environment's state before each step: what a person is shown
    next_state: Any  # (..., steps, ...) and after it
    # (..., steps, 2) what a synthetic human with the belief, and one who knows the truth, think of each step; None: not known yet
    worth: Array | None = None


class Queries(NamedTuple):
    """Pairs of segments that a teacher is asked to compare."""

    number: Array  # (queries,) int32, a query's identity; NOBODY where a place is left empty
    segments: Segments  # (queries, 2, steps, ...)


class Answers(NamedTuple):
    """What was said of queries."""

    number: Array  # (answers,) int32, of the query that each answers
    preferred: Array  # (answers,) P(first preferred): 1, 0, or 1/2 for a tie
    weight: Array  # (answers,) how many people say so; 0 where the query was skipped


@struct.dataclass
class PreferenceSet:
    """Queries with the answers to them so far. Places without a query have the number NOBODY."""

    number: Array  # (capacity,) int32
    observation: Array  # (capacity, 2, steps, observation_size)
    action: Array  # (capacity, 2, steps, action_size) or (capacity, 2, steps)
    mask: Array  # (capacity, 2, steps) bool
    reward: Array  # (capacity, 2, steps) r_A
    preferred: Array  # (capacity,) mean of the answers' P(first preferred)
    weight: Array  # (capacity,) how many people answered
    since: Array  # (capacity,) int32, the round from which on the answer is known


def empty(capacity: int, steps: int, observation_size: int, action_space: ActionSpace) -> PreferenceSet:
    """A set with room for `capacity` queries, whose segments have at most `steps` steps."""
    shape = (capacity, 2, steps)
    discrete = isinstance(action_space, Discrete)
    return PreferenceSet(
        number=jnp.full(capacity, NOBODY, jnp.int32),
        observation=jnp.zeros((*shape, observation_size), jnp.float32),
        action=jnp.zeros(shape, jnp.int32) if discrete else jnp.zeros((*shape, action_space.size), jnp.float32),
        mask=jnp.zeros(shape, bool),
        reward=jnp.zeros(shape, jnp.float32),
        preferred=jnp.zeros(capacity, jnp.float32),
        weight=jnp.zeros(capacity, jnp.float32),
        since=jnp.zeros(capacity, jnp.int32),
    )


def ask(
    preferences: PreferenceSet, segments: Segments, index: Array, unasked: Array, room: int, budget: Array
) -> tuple[PreferenceSet, Queries]:
    """Writes the pairs that are asked in round `index` (from 0), gives them numbers, and returns both.

    What was recorded before the training stands in front of them and has lower numbers. What would be asked in the first `unasked`
    rounds or beyond the budget has no number, isn't written, and no answer to it is filed.

    Args:
      unasked: rounds before the first query.
      room: places at the set's end for what is asked in the training.
      budget: queries that are asked in all.
    """
    per_round = segments.mask.shape[0]
    asked = jnp.arange(per_round, dtype=jnp.int32) + (index - unasked) * per_round
    recorded = preferences.number.shape[0] - room
    first = jnp.max(preferences.number[:recorded], initial=NOBODY) + 1
    number = jnp.where((asked >= 0) & (asked < budget), first + asked, NOBODY)
    segments = segments._replace(mask=segments.mask.astype(bool))
    shown = _padded(segments, preferences.mask.shape[-1])
    nothing = jnp.zeros(per_round, jnp.float32)
    rows = PreferenceSet(number, shown.observation, shown.action, shown.mask, shown.reward, nothing, nothing, nothing)
    chex.assert_equal_shape_suffix([rows.mask, preferences.mask], 2)
    position = recorded + index * per_round

    def write(old: Array, new: Array) -> Array:
        there = jax.lax.dynamic_slice_in_dim(old, position, per_round, 0)
        kept = jax.vmap(jnp.where)(number != NOBODY, new.astype(old.dtype), there)
        return jax.lax.dynamic_update_slice_in_dim(old, kept, position, 0)

    return jax.tree.map(write, preferences, rows), Queries(number, segments)


def _padded(rows: Any, steps: int) -> Any:
    """Segments, or a set, with room for `steps` steps."""
    pad = lambda row: jnp.pad(row, [(0, steps - row.shape[2] if axis == 2 else 0) for axis in range(row.ndim)])
    fields = {name: pad(getattr(rows, name)) for name in ("observation", "action", "mask", "reward")}
    return rows._replace(**fields) if isinstance(rows, Segments) else rows.replace(**fields)


def recording(segments: Segments, answers: Answers) -> PreferenceSet:
    """Pairs (n, 2, steps, ...), numbered from 0 on, with what was said of them: known from the first round of a training on."""
    number = jnp.arange(segments.mask.shape[0], dtype=jnp.int32)
    nothing = jnp.zeros(number.shape, jnp.float32)
    mask = segments.mask.astype(bool)
    asked = PreferenceSet(
        number, segments.observation, segments.action, mask, segments.reward, nothing, nothing, jnp.zeros_like(number)
    )
    return file(_in_32_bits(asked), answers, jnp.zeros((), jnp.int32))


def _in_32_bits(preferences: PreferenceSet) -> PreferenceSet:
    """The set in the types that `empty` states, whatever those who recorded it computed with."""

    def stated(row: Array) -> Array:
        kind = jnp.result_type(row)
        if kind == jnp.bool_:
            return jnp.asarray(row)
        return jnp.asarray(row, jnp.int32 if jnp.issubdtype(kind, jnp.integer) else jnp.float32)

    return jax.tree.map(stated, preferences)


def file(preferences: PreferenceSet, answers: Answers, now: Array) -> PreferenceSet:
    """Files answers under the numbers of their queries, in round `now`; those to queries that aren't in the set are dropped.

    A query that was answered before keeps the mean of all answers, and counts from its first one on.
    """
    chex.assert_equal_shape(list(answers))
    same = (preferences.number[:, None] == answers.number[None]) & (answers.number != NOBODY)[None]
    said = jnp.where(same, answers.weight[None].astype(jnp.float32), 0.0)  # (capacity, answers)
    new, total = jnp.sum(said, 1), preferences.weight + jnp.sum(said, 1)
    mean = preferences.preferred * preferences.weight + said @ answers.preferred.astype(jnp.float32)
    return preferences.replace(
        preferred=jnp.where(new > 0, mean / jnp.where(total > 0, total, 1.0), preferences.preferred),
        weight=total,
        since=jnp.where((new > 0) & (preferences.weight == 0), now, preferences.since).astype(jnp.int32),
    )


def known(preferences: PreferenceSet, now: Array) -> PreferenceSet:
    """The set as it was known in round `now`: other answers weigh nothing."""
    there = (preferences.number != NOBODY) & (preferences.since <= now)
    return preferences.replace(weight=jnp.where(there, preferences.weight, 0.0))


def joined(first: PreferenceSet, second: PreferenceSet) -> PreferenceSet:
    """The queries of both, as one set. Their numbers have to differ."""
    steps = max(first.mask.shape[-1], second.mask.shape[-1])
    return jax.tree.map(lambda *rows: jnp.concatenate(rows), _padded(first, steps), _padded(second, steps))


def before(recorded: PreferenceSet | None, room: PreferenceSet, asks: bool) -> PreferenceSet:
    """The set before a training: what was recorded, and `room` for what will be asked, behind it.

    Where nobody will be asked, the recording lies in that room: a training by a recording has the shapes of its teacher's.
    """
    if recorded is None:
        return room
    recorded = _in_32_bits(recorded)
    if asks:
        return joined(recorded, room)
    blank = max(room.number.shape[0] - recorded.number.shape[0], 0)
    return joined(recorded, jax.tree.map(lambda rows: rows[:blank], room))


def at_once(preferences: PreferenceSet) -> PreferenceSet:
    """The set with every answer known from the first round on, whenever it came."""
    return preferences.replace(since=jnp.zeros_like(preferences.since))


def checked(answers: Answers, multiple: int) -> Answers:
    """Answers from outside the program as arrays, filled up with places for nobody to a multiple of `multiple`.

    So few different sizes come that hardly anything is compiled again.

    Raises:
      ValueError: they aren't of one length, or a value isn't right.
    """
    number, preferred, weight = (np.asarray(values) for values in answers)
    if not number.shape == preferred.shape == weight.shape or number.ndim != 1:
        raise ValueError(f"answers have shapes {number.shape}, {preferred.shape}, {weight.shape}: give (n,) of each")
    if number.size and not np.issubdtype(number.dtype, np.integer):
        raise ValueError(f"answers have numbers of type {number.dtype}: give those of their queries, whole numbers")
    for name, values, right, words in (
        ("preferred", preferred, (preferred >= 0) & (preferred <= 1), "from 0 to 1"),
        ("weight", weight, (weight >= 0) & np.isfinite(weight), "0 or more"),
    ):
        if not np.all(right):
            raise ValueError(f"answers have {name} {values[~right][0]}: give numbers {words}")
    # wrapped to 32 bits, a number that no query has would be another one's
    number = np.where((number >= 0) & (number <= MOST), number, NOBODY)
    blank = -number.size % multiple
    fill = lambda values, value, kind: jnp.asarray(np.pad(values, (0, blank), constant_values=value).astype(kind))
    return Answers(fill(number, NOBODY, np.int32), fill(preferred, 0, np.float32), fill(weight, 0, np.float32))


def answered(preferences: PreferenceSet) -> PreferenceSet:
    """The queries that somebody has answered, by their numbers, as numpy arrays: what is worth keeping."""
    rows = jax.tree.map(np.asarray, preferences)
    there = np.flatnonzero((rows.number != NOBODY) & (rows.weight > 0))
    order = there[np.argsort(rows.number[there], kind="stable")]
    return jax.tree.map(lambda row: row[order], rows)


# --- files ------------------------------------------------------------------------------------------------------------------


def save(path: str | Path, preferences: PreferenceSet) -> None:
    """Writes the queries that were answered to a file (.npz). Raises NotWrittenError."""
    kept = answered(preferences)
    buffer = io.BytesIO()
    np.savez_compressed(buffer, format=np.array(FORMAT), **{name: getattr(kept, name) for name in _FIELDS})
    files.write_whole(Path(path), buffer.getvalue())


def load(path: str | Path) -> PreferenceSet:
    """A set that `save` wrote.

    Raises:
      ValueError: no such file, or not one of preferences; one line says which and why.
    """
    try:
        with np.load(io.BytesIO(Path(path).read_bytes())) as stored:
            written, rows = int(stored["format"]), PreferenceSet(**{name: stored[name] for name in _FIELDS})
    except OSError as error:
        raise ValueError(f"preferences {str(path)!r} can't be read: {error.strerror or error}") from None
    except (EOFError, KeyError, ValueError, zipfile.BadZipFile):
        raise ValueError(f"preferences {str(path)!r} are no file that `save` wrote") from None
    if written != FORMAT:
        raise ValueError(f"preferences {str(path)!r} have format {written}, not {FORMAT}")
    if len(set(rows.number.tolist())) != len(rows.number):
        raise ValueError(f"preferences {str(path)!r} have two queries of one number: numbers have to differ")
    return rows


_FIELDS = tuple(PreferenceSet.__dataclass_fields__)


def check(
    preferences: PreferenceSet, observation_size: int, action_space: ActionSpace, what: str = "preferences"
) -> None:
    """Raises ValueError, in one line, if a set's segments aren't of an environment with such spaces."""
    fits = jax.eval_shape(lambda: empty(0, preferences.mask.shape[-1], observation_size, action_space))
    for name in ("observation", "action"):
        found, right = getattr(preferences, name).shape[1:], getattr(fits, name).shape[1:]
        if found != right:
            raise ValueError(f"{what} have {name}s of shape {found}, and the environment's are {right}: name its own")
    if not preferences.number.shape[0]:
        raise ValueError(f"{what} are empty: nobody has answered a query")
