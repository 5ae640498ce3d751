"""What a browser needs to draw clips: a view of the environment, fetched once, and what moves in each clip, in few bytes.

A clip is what films show: the environment's `scene` at the moments of a segment, with straight lines between one moment and the
next. All lengths are whole numbers of `grid`, angles of `TURN`. A number that changes is a text: its first value and its
changes from moment to moment, as `written`. `pages/clip.js` reads all of it back.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Iterable, Iterator, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

from peps_envs import Environment
from peps_envs.scene import Circle, Polyline, Rectangle, Scene, Shape, Text
from peps_jax.drawing import scenes
from peps_jax.drawing.panels import ROLES
from peps_jax.preferences.data import Segments

FINENESS = 500  # the grid is the power of ten below the view's smaller side by this
TURN = 1e-3  # rad
STEP = 0.25  # s that a step of an environment takes which has no time of its own
DIGITS = "ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/"

Numbers = tuple[int, ...]  # of a shape: places and lengths on the grid


class Look(NamedTuple):
    """What a shape looks like, wherever it is."""

    colour: str
    outline: str | None = None
    text: str | None = None


class Drawn(NamedTuple):
    """A shape in whole numbers: equal ones are one."""

    kind: str
    numbers: Numbers  # first what is said of where it is, `PLACES` of them, then lengths and angles
    look: Look


PLACES = {"rectangle": 2, "circle": 2, "text": 2}  # all of a polyline's numbers are places


def view(environment: Environment, params: Any) -> dict[str, Any]:
    """What all clips of an environment share: scales, colours, and what there is to see at a start.

    Raises:
      ValueError: the environment has no scene.
    """
    scene = _start(environment, _Params(params))
    left, right, low, high = scene.extent
    return {
        "grid": _grid(scene),
        "turn": TURN,
        "width": right - left,
        "height": high - low,
        "y_down": scene.y_down,
        "background": scene.background,
        "step_seconds": 1 / getattr(environment, "policy_hz", 1 / STEP),
        "colours": ROLES,
        "shapes": [_entry(shape) for shape in _in_numbers(scene, _grid(scene))],
    }


def encode(environment: Environment, params: Any, states: Any, next_states: Any, mask: Any) -> dict[str, Any]:
    """What moves in one segment, whose `states` (steps, ...) lead to `next_states` where `mask` (steps,) goes on.

    Raises:
      ValueError: the environment has no scene, or the segment no step.
    """
    start = _start(environment, _Params(params))
    steps = int(np.sum(np.asarray(mask)))
    if not steps:
        raise ValueError("mask goes on nowhere: a clip needs a step")
    segment = jax.tree.map(np.asarray, Segments(None, None, mask, None, states, next_states))
    shown = scenes.scenes_of(environment, params, scenes.states_of(segment), range(steps + 1))
    grid = _grid(start)
    extents = [_whole(scene.extent, grid) for scene in shown]
    moments = [_in_numbers(scene, grid) for scene in shown]
    known = {shape: place for place, shape in enumerate(_in_numbers(start, grid))}
    entries = [entry for _, entry in sorted(_entries(moments, extents, known), key=lambda pair: -pair[0])]
    return {"steps": steps, "extent": [_track(row) for row in zip(*extents, strict=True)], "shapes": entries}


class _Params:
    """Parameters to look up what was made of them: equal where all their numbers are."""

    def __init__(self, params: Any):
        self.params = params
        leaves, structure = jax.tree.flatten(params)
        self.key = (structure, *(np.asarray(leaf).tobytes() for leaf in leaves))

    def __hash__(self) -> int:
        return hash(self.key)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Params) and self.key == other.key


@functools.lru_cache(maxsize=16)
def _start(environment: Environment, params: _Params) -> Scene:
    """What there is to see at a start."""
    state, _ = environment.reset(jax.random.key(0), params.params)
    scene = environment.scene(jax.tree.map(np.asarray, state), params.params)
    if scene is None:
        raise ValueError(f"{type(environment).__name__} has no scene: give it one, see peps_envs.scene")
    return scene


def _grid(scene: Scene) -> float:
    left, right, low, high = scene.extent
    return 10.0 ** math.floor(math.log10(min(right - left, high - low) / FINENESS))


def _whole(numbers: Iterable[float], unit: float) -> Numbers:
    return tuple(round(float(number) / unit) for number in numbers)


def _in_numbers(scene: Scene, grid: float) -> list[Drawn]:
    """A scene's shapes in whole numbers, in their order."""
    return [_drawn(shape, grid) for shape in scene.shapes]


def _drawn(shape: Shape, grid: float) -> Drawn:
    match shape:
        case Rectangle():
            lengths = _whole((shape.x, shape.y, shape.width, shape.height), grid)
            return Drawn(shape.kind, (*lengths, *_whole([shape.angle], TURN)), Look(shape.colour, shape.outline))
        case Circle():
            lengths = _whole((shape.x, shape.y, shape.radius), grid)
            return Drawn(shape.kind, lengths, Look(shape.colour, shape.outline))
        case Polyline():
            return Drawn(shape.kind, _whole(np.ravel(shape.points), grid), Look(shape.colour))
        case Text():
            return Drawn(shape.kind, _whole((shape.x, shape.y), grid), Look(shape.colour, text=shape.text))


def _sort(shape: Drawn) -> tuple[str, int]:
    """Only shapes of one sort may be the same thing at two moments."""
    return shape.kind, len(shape.numbers)


def _places(shape: Drawn) -> int:
    return PLACES.get(shape.kind, len(shape.numbers))


def _shifted(shape: Drawn, x: int, y: int) -> Drawn:
    """`shape` seen from (x, y)."""
    shift = (x, y) * (_places(shape) // 2)
    numbers = tuple(number - by for number, by in zip(shape.numbers, shift, strict=False))
    return shape._replace(numbers=numbers + shape.numbers[len(shift) :])


# --- what stands still, what goes along with the view, and what moves -------------------------------------------------------


def _entries(
    moments: Sequence[Sequence[Drawn]], extents: Sequence[Numbers], known: dict[Drawn, int]
) -> Iterator[tuple[int, Any]]:
    """What a clip says of its shapes, each with how many lie over it in the first scene that shows it."""
    over: dict[Drawn, int] = {}
    for shapes in moments:
        for place, shape in enumerate(shapes):
            over.setdefault(shape, len(shapes) - place)
    for sort in dict.fromkeys(map(_sort, over)):
        fixed, rest = _without_fixed(
            [[shape for shape in shapes if _sort(shape) == sort] for shapes in moments], extents
        )
        yield from _runs([shape for shape in fixed if shape in known], known, over)
        yield from _repeats([shape for shape in fixed if shape not in known], over)
        for shapes in _by_place(rest):
            first = next(shape for shape in shapes if shape is not None)
            yield over[first], _moving(shapes, extents)


def _without_fixed(
    moments: Sequence[Sequence[Drawn]], extents: Sequence[Numbers]
) -> tuple[list[Drawn], Sequence[Sequence[Drawn]]]:
    """Shapes that stand still all the time, whenever they are in sight, and every moment's others.

    Who moves and stops is in sight of some moments at one place, too; then as many are left of all moments only if it is
    counted as one that moves.
    """
    there = [frozenset(shapes) for shapes in moments]
    pairs = list(zip(there, extents, strict=True))
    stays = lambda shape: all(shape in shapes or not _in_sight(shape, extent) for shapes, extent in pairs)
    fixed = {shape: None for shapes in moments for shape in shapes if stays(shape)}
    rest = [[shape for shape in shapes if shape not in fixed] for shapes in moments]
    varies = lambda rows: len({len(row) for row in rows}) > 1
    if varies(rest) and not varies(moments):
        return [], moments
    return list(fixed), rest


def _in_sight(shape: Drawn, extent: Numbers) -> bool:
    left, right, low, high = extent
    count = _places(shape)
    xs, ys = shape.numbers[0:count:2], shape.numbers[1:count:2]
    match shape.kind:
        case "rectangle":
            reach = math.ceil(math.hypot(*shape.numbers[2:4]) / 2)
        case "circle":
            reach = shape.numbers[2]
        case _:
            reach = 0
    across = min(xs) - reach < right and max(xs) + reach > left
    return across and min(ys) - reach < high and max(ys) + reach > low


def _by_place(moments: Sequence[Sequence[Drawn]]) -> Iterator[list[Drawn | None]]:
    """The moments' n-th shapes, for each n; None where a moment has fewer."""
    most = max(map(len, moments))
    for place in range(most):
        yield [shapes[place] if place < len(shapes) else None for shapes in moments]


def _runs(shapes: Sequence[Drawn], known: dict[Drawn, int], over: dict[Drawn, int]) -> Iterator[tuple[int, list[int]]]:
    """Shapes that the view has, as [first, last] of its places."""
    runs: list[list[int]] = []
    above: list[int] = []
    for shape in sorted(shapes, key=known.__getitem__):
        place = known[shape]
        if runs and runs[-1][1] == place - 1 and over[shape] < above[-1]:
            runs[-1][1] = place
        else:
            runs.append([place, place])
            above.append(over[shape])
    yield from zip(above, runs, strict=True)


def _repeats(shapes: Sequence[Drawn], over: dict[Drawn, int]) -> Iterator[tuple[int, dict[str, Any]]]:
    """Shapes that the view hasn't; several at equal distances are one with the number of its repeats and their distance."""
    alike: dict[tuple[str, Numbers, Look], list[Drawn]] = {}
    for shape in shapes:
        centred = _shifted(shape, *shape.numbers[:2])
        alike.setdefault((shape.kind, centred.numbers, shape.look), []).append(shape)
    for group in alike.values():
        rows = sorted(group, key=lambda shape: shape.numbers[1::-1])
        while rows:
            step = _step(rows[:2])
            count = 1
            while count < len(rows) and _step(rows[count - 1 : count + 1]) == step:
                count += 1
            repeats = {"repeats": [count, *step]} if count > 1 else {}
            yield max(over[shape] for shape in rows[:count]), _entry(rows[0]) | repeats
            rows = rows[count:]


def _step(pair: Sequence[Drawn]) -> Numbers:
    first, last = pair[0].numbers[:2], pair[-1].numbers[:2]
    return (last[0] - first[0], last[1] - first[1])


def _moving(shapes: Sequence[Drawn | None], extents: Sequence[Numbers]) -> dict[str, Any]:
    """One shape at all moments; what goes along with the view is told from its corner."""
    there = [moment for moment, shape in enumerate(shapes) if shape is not None]
    seen = [shapes[moment] for moment in there]
    along = [_shifted(shape, extents[moment][0], extents[moment][2]) for moment, shape in zip(there, seen, strict=True)]
    with_view = len(set(along)) == 1 and len(set(seen)) > 1
    told = along if with_view else seen
    entry = {"kind": told[0].kind, "at": [_track(row) for row in zip(*(shape.numbers for shape in told), strict=True)]}
    for name, values in zip(Look._fields, zip(*(shape.look for shape in told), strict=True), strict=True):
        entry |= {name: _changes(values)} if any(values) else {}
    entry |= {"along": True} if with_view else {}
    return (
        entry | ({"from": there[0]} if there[0] else {}) | ({"moments": len(there)} if len(there) < len(shapes) else {})
    )


# --- how it is written ------------------------------------------------------------------------------------------------------


def _entry(shape: Drawn) -> dict[str, Any]:
    look = {name: value for name, value in shape.look._asdict().items() if value is not None}
    return {"kind": shape.kind, "at": list(shape.numbers)} | look


def _changes(values: Sequence[str | None]) -> Any:
    """A value, or [moment, value] from each moment on at which it is another."""
    changed = [[place, value] for place, value in enumerate(values) if not place or value != values[place - 1]]
    return values[0] if len(changed) == 1 else changed


def _track(values: Sequence[int]) -> int | str:
    """A number, or where it changes the first one and its changes."""
    if len(set(values)) == 1:
        return values[0]
    return written([values[0], *np.diff(values).tolist()])


def written(numbers: Iterable[int]) -> str:
    """Whole numbers as a text: of each the sign and five bits a letter, the low ones first, and 32 more where it goes on."""
    text = []
    for number in numbers:
        rest = -2 * number - 1 if number < 0 else 2 * number
        while rest >= 32:
            text.append(DIGITS[32 + rest % 32])
            rest //= 32
        text.append(DIGITS[rest])
    return "".join(text)
