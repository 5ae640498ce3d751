"""Scenes of any environment with matplotlib: a moment, strips of several, films. It is imported on the first one drawn.

A clip is a sequence of scenes; what they show is `peps_envs.scene`.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np

from peps_envs import Environment, pictures
from peps_envs.pictures import draw as draw
from peps_envs.scene import Circle, Rectangle, Scene, Shape
from peps_jax.drawing.panels import INK, QUIET, panels_of
from peps_jax.preferences.data import Segments

if TYPE_CHECKING:
    from matplotlib.figure import Figure

WIDTH = 2.0  # inches, of a scene in a strip across
CLEAR = "40"  # opacity of a ghost's colour, from 00 to ff
COLOURS = 64  # of a small film's palette
TITLE = 0.45  # inches between one scene and the next, for what is written there


def states_of(segment: Segments) -> Any:
    """The states of one `segment` (steps, ...) from its first to that of its end: (moments, ...)."""
    steps = int(np.sum(segment.mask))
    return jax.tree.map(
        lambda before, after: np.concatenate([before[:steps], after[steps - 1 : steps]]),
        segment.state,
        segment.next_state,
    )


def scenes_of(environment: Environment, params: Any, states: Any, times: Sequence[float]) -> list[Scene]:
    """What there is to see of `states` (moments, ...) at `times`, in steps and parts of them; as it ended after the end."""
    last = len(jax.tree.leaves(states)[0]) - 1
    scenes = []
    for time in times:
        before = min(int(time), last)
        row = lambda place: jax.tree.map(lambda leaf: leaf[place], states)
        state = between(row(before), row(min(before + 1, last)), min(time, last) - before)
        scenes.append(environment.scene(state, params))
    return scenes


def between(before: Any, after: Any, share: float) -> Any:
    """A state `share` of the way between two: real numbers by interpolation, all else as it was before."""

    def mix(old: Any, new: Any) -> Any:
        if not jnp.issubdtype(old.dtype, jnp.floating):
            return old
        with np.errstate(invalid="ignore"):  # what is infinite before and after stays so
            return np.where(old == new, old, (1 - share) * np.asarray(old, float) + share * np.asarray(new, float))

    return jax.tree.map(mix, before, after)


def with_ghost(scene: Scene, expected: Scene) -> Scene:
    """`scene`, and over it, as one sees through it, what is elsewhere in `expected`."""
    ghosts = [_ghost(shape) for shape in expected.shapes if shape not in scene.shapes]
    return dataclasses.replace(scene, shapes=(*scene.shapes, *ghosts))


def _ghost(shape: Shape) -> Shape:
    from matplotlib.colors import to_hex

    clear = dataclasses.replace(shape, colour=to_hex(pictures.colour(shape.colour)) + CLEAR)  # as CSS has it, too
    return dataclasses.replace(clear, outline="ink") if isinstance(shape, Rectangle | Circle) else clear


def strips(clips: Mapping[str, Sequence[Scene]], labels: Sequence[str], note: str = "") -> Figure:
    """A column for each clip, by its title, and a row for each of its scenes, by its label."""
    figure, grid = panels_of(len(labels), len(clips), 3.2, 3.2 * _slope(clips) + TITLE)
    for column, (title, clip) in enumerate(clips.items()):
        for axes, scene, label in zip(grid[:, column], clip, labels, strict=True):
            draw(axes, scene)
            axes.set_ylabel(label if column == 0 else "", color=INK, fontsize=8)
        grid[0, column].set_title(title, color=INK, fontsize=9)
    return _noted(figure, note)


def strips_across(clips: Mapping[str, Mapping[str, Scene]], note: str = "") -> Figure:
    """A row for each clip, by its title, and in it its scenes by their labels; all clips have equally many."""
    heights = [WIDTH * _slope({title: list(clip.values())}) + TITLE for title, clip in clips.items()]
    figure, grid = panels_of(len(clips), max(map(len, clips.values())), WIDTH, heights)
    for row, (title, clip) in zip(grid, clips.items(), strict=True):
        for axes, (label, scene) in zip(row, clip.items(), strict=True):
            draw(axes, scene)
            axes.set_xlabel(label, color=QUIET, fontsize=7, labelpad=2)
        row[0].set_title(title, color=INK, fontsize=9, loc="left")
    return _noted(figure, note)


def _noted(figure: Figure, note: str) -> Figure:
    if note:
        figure.supxlabel(note, color=INK, fontsize=8)
    return figure


def film(
    clips: Mapping[str, Sequence[Scene]], path: Path, rate: float, columns: int = 1, width: float = 6.0, rest: int = 0
) -> None:
    """Writes a GIF of `rate` scenes a second: the clips by their titles, in rows of so many `columns`.

    A clip is `width` inches wide. One that is over before the others stands still, and all do for `rest` pictures at the end.
    """
    from PIL import Image

    shown = list(clips.items())
    rows = [dict(shown[first : first + columns]) for first in range(0, len(shown), columns)]
    figure, grid = panels_of(len(rows), columns, width, [width * _slope(row) + TITLE for row in rows])
    for axes in grid.flat[len(clips) :]:
        axes.set_axis_off()
    frames = []
    for place in range(max(map(len, clips.values())) + rest):
        for axes, (title, clip) in zip(grid.flat, clips.items(), strict=False):
            draw(axes, clip[min(place, len(clip) - 1)])
            axes.set_title(title, color=INK, fontsize=9, loc="left")
        if not frames:
            figure.canvas.draw()
            figure.canvas.draw()  # the layout has settled after the second time; from then on nothing may jump
            figure.set_layout_engine("none")
        figure.canvas.draw()
        frames.append(Image.fromarray(np.asarray(figure.canvas.buffer_rgba())[..., :3].copy()))
    first, *rest = frames
    first.save(path, save_all=True, append_images=rest, duration=round(1000 / rate), loop=0)


def small_film(
    clips: Mapping[str, Sequence[Scene]], path: Path, rate: float, columns: int = 1, width: float = 6.0, rest: int = 0
) -> None:
    """As `film`, without its white margin, and with one palette of `COLOURS` for all its pictures."""
    from PIL import Image, ImageChops, ImageSequence

    film(clips, path, rate, columns, width, rest)
    with Image.open(path) as whole:
        frames = [frame.convert("RGB") for frame in ImageSequence.Iterator(whole)]
        times = [frame.info.get("duration", whole.info["duration"]) for frame in ImageSequence.Iterator(whole)]
    white = Image.new("RGB", frames[0].size, "white")
    inside = ImageChops.difference(frames[0], white).point(lambda part: 255 * (part > 8)).getbbox()
    frames = [frame.crop(inside) for frame in frames]
    palette = frames[-1].quantize(COLOURS)
    first, *rest = [frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
    first.save(path, save_all=True, append_images=rest, duration=times, loop=0, optimize=True)


def _slope(clips: Mapping[str, Sequence[Scene]]) -> float:
    """Height by width of the highest scene in view."""
    extents = (scene.extent for clip in clips.values() for scene in clip)
    return max((high - low) / (right - left) for left, right, low, high in extents)
