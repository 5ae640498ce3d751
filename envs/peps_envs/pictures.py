"""Scenes as pictures, with matplotlib, which is imported on the first one drawn."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from peps_envs.scene import Circle, Polyline, Rectangle, Scene, Shape, Text

if TYPE_CHECKING:
    from matplotlib.axes import Axes

ROLES = {  # the colours of what a scene shows, see `peps_envs.scene`; CSS knows them too
    "ink": "#2b2b2b",
    "quiet": "#8a8a8a",
    "floor": "#fbfaf7",
    "wall": "#4a4a4a",
    "pit": "#9c5a33",
    "goal": "#57a773",
    "ice": "#a9d3f0",
    "snow": "#f4f1e8",
    "sand": "#f6e3a1",
    "firm sand": "#dfb94f",
    "road": "#d9d9d6",
    "edge line": "#8a8a8a",
    "lane line": "#ffffff",
    "agent": "#2f9e78",
    "other": "#1c6dd0",
    "wreck": "#c2255c",
}
OUTLINE, LINE = 0.6, 1.2  # points, widths of lines
DOTS = 100  # per inch, of `picture`


def colour(role: str) -> str:
    """The colour of a role in a scene; any other colour is itself."""
    return ROLES.get(role, role)


def picture(scene: Scene, pixels: int = 480) -> np.ndarray:
    """`scene` as (height, width, 3) uint8; the longer side has so many `pixels`."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    left, right, low, high = scene.extent
    width, height = right - left, high - low
    inches = pixels / DOTS / max(width, height)
    figure = Figure(figsize=(width * inches, height * inches), dpi=DOTS)
    canvas = FigureCanvasAgg(figure)
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    draw(axes, scene)
    figure.set_facecolor(axes.get_facecolor())  # what rounding to whole pixels leaves at the edges
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()


def draw(axes: Axes, scene: Scene) -> None:
    """`scene` in place of all that was on `axes`."""
    axes.clear()
    frame(axes, scene)
    add(axes, scene.shapes)


def frame(axes: Axes, scene: Scene) -> None:
    """The view of `scene`, without its shapes: limits, background, no ticks."""
    left, right, low, high = scene.extent
    bottom, top = (high, low) if scene.y_down else (low, high)
    axes.set(xlim=(left, right), ylim=(bottom, top), aspect="equal", xticks=[], yticks=[])
    axes.set_facecolor(colour(scene.background))
    for spine in axes.spines.values():
        spine.set_visible(False)


def add(axes: Axes, shapes: Sequence[Shape]) -> None:
    """`shapes` over one another in their order, above heat maps (0) and below what is drawn on top (from 2 on)."""
    for place, shape in enumerate(shapes):
        _add(axes, shape, 1 + place / len(shapes))


def _add(axes: Axes, shape: Shape, order: float) -> None:
    from matplotlib import patches

    match shape:
        case Rectangle():
            corner = (shape.x - shape.width / 2, shape.y - shape.height / 2)
            turned = dict(angle=np.degrees(shape.angle), rotation_point="center", zorder=order)
            axes.add_patch(patches.Rectangle(corner, shape.width, shape.height, **turned, **_style(shape)))
        case Circle():
            axes.add_patch(patches.Circle((shape.x, shape.y), shape.radius, zorder=order, **_style(shape)))
        case Polyline():
            axes.plot(*np.transpose(shape.points), color=colour(shape.colour), linewidth=LINE, zorder=order)
        case Text():
            style = dict(ha="center", va="center", fontsize=7, clip_on=True, zorder=order)
            axes.text(shape.x, shape.y, shape.text, color=colour(shape.colour), **style)


def _style(shape: Rectangle | Circle) -> dict[str, Any]:
    if shape.outline is None:
        return dict(facecolor=colour(shape.colour), linewidth=0)
    return dict(facecolor=colour(shape.colour), edgecolor=colour(shape.outline), linewidth=OUTLINE)
