"""Scenes of any environment with matplotlib: a moment, strips of several, films. It is imported on the first one drawn.

A clip is a sequence of scenes; what they show is `peps_envs.scene`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np

from peps_envs import Environment
from peps_envs.pictures import draw as draw
from peps_envs.scene import Scene
from peps_jax.drawing.panels import INK, panels_of
from peps_jax.preferences.data import Segments

if TYPE_CHECKING:
    from matplotlib.figure import Figure

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


def strips(clips: Mapping[str, Sequence[Scene]], labels: Sequence[str], note: str = "") -> Figure:
    """A column for each clip, by its title, and a row for each of its scenes, by its label."""
    figure, grid = panels_of(len(labels), len(clips), 3.2, 3.2 * _slope(clips) + TITLE)
    for column, (title, clip) in enumerate(clips.items()):
        for axes, scene, label in zip(grid[:, column], clip, labels, strict=True):
            draw(axes, scene)
            axes.set_ylabel(label if column == 0 else "", color=INK, fontsize=8)
        grid[0, column].set_title(title, color=INK, fontsize=9)
    if note:
        figure.supxlabel(note, color=INK, fontsize=8)
    return figure


def film(
    clips: Mapping[str, Sequence[Scene]], path: Path, rate: float, across: bool = False, width: float = 6.0
) -> None:
    """Writes a GIF of `rate` scenes a second: the clips below one another, or side by side if `across`, by their titles.

    A clip is `width` inches wide. One that is over before the others stands still.
    """
    from PIL import Image

    rows, columns = (1, len(clips)) if across else (len(clips), 1)
    figure, grid = panels_of(rows, columns, width, width * _slope(clips) + TITLE)
    pictures = []
    for place in range(max(map(len, clips.values()))):
        for axes, (title, clip) in zip(grid.flat, clips.items(), strict=True):
            draw(axes, clip[min(place, len(clip) - 1)])
            axes.set_title(title, color=INK, fontsize=9, loc="left")
        if not pictures:
            figure.canvas.draw()
            figure.canvas.draw()  # the layout has settled after the second time; from then on nothing may jump
            figure.set_layout_engine("none")
        figure.canvas.draw()
        pictures.append(Image.fromarray(np.asarray(figure.canvas.buffer_rgba())[..., :3].copy()))
    first, *rest = pictures
    first.save(path, save_all=True, append_images=rest, duration=round(1000 / rate), loop=0)


def _slope(clips: Mapping[str, Sequence[Scene]]) -> float:
    """Height by width of the highest scene in view."""
    extents = (scene.extent for clip in clips.values() for scene in clip)
    return max((high - low) / (right - left) for left, right, low, high in extents)
