"""Navigation domains as the paper draws them, routes on them, and values over them."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

import numpy as np

from peps_envs import pictures
from peps_envs.navigation import NavigationParams
from peps_envs.navigation.scene import ground
from peps_envs.scene import Rectangle
from peps_jax.drawing.panels import INK, QUIET, colour_of, row_below

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

ORDER = ("goal", "pit", "ice", "sand", "firm sand", "wall")  # in which a key names them
START = dict(marker="o", markersize=7, color="white", markeredgecolor=INK, markeredgewidth=1.3)
SOLID = ("wall", "pit", "goal")  # what hides a heat map below it; all else is outlined on it


def draw_map(axes: Axes, params: NavigationParams, heat: bool = False) -> None:
    """A domain as the paper draws it, y downwards: walls dark grey, pit brown, goal green, ice blue, sand yellow.

    On a `heat` map ice and sand are outlines, for the heat to be seen.
    """
    arena = ground(params)
    pictures.frame(axes, arena)
    for spine in axes.spines.values():
        spine.set(visible=True, color=pictures.colour("wall"), linewidth=2.5)
    floor, *areas = arena.shapes
    if not heat:
        pictures.add(axes, (floor, *areas))
        return
    pictures.add(axes, [area for area in areas if area.colour in SOLID])
    for area in areas:
        if area.colour not in SOLID:
            _outline(axes, area)
        if area.colour != "wall":
            _name(axes, area)


def key_below(figure: Figure, shown: Iterable[NavigationParams]) -> None:
    """What the colours on the maps of `shown` are, as one row under all panels."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    roles = {area.colour for params in shown for area in ground(params).shapes[1:]}
    areas = [Patch(color=pictures.colour(role), label=role) for role in ORDER if role in roles]
    start = Line2D([], [], linestyle="", label="start", **START)
    row_below(figure, [start, *areas], fontsize=9, handlelength=1.2)


def _outline(axes: Axes, area: Rectangle) -> None:
    from matplotlib.patches import Rectangle as Patch

    corner = (area.x - area.width / 2, area.y - area.height / 2)
    style = dict(fill=False, edgecolor=INK, linewidth=0.9, linestyle=(0, (3, 2)))
    axes.add_patch(Patch(corner, area.width, area.height, zorder=2, **style))


def _name(axes: Axes, area: Rectangle) -> None:
    from matplotlib.patheffects import Normal, Stroke

    halo = [Stroke(linewidth=1.6, foreground=INK, alpha=0.7), Normal()]  # for it to be read on every colour
    style = dict(ha="center", va="center", fontsize=7, color="white", path_effects=halo)
    axes.text(area.x, area.y, area.colour.split()[-1], zorder=3, **style)


def draw_route(axes: Axes, route: np.ndarray, method: str, alpha: float, width: float = 1.2) -> None:
    """A route (steps + 1, 2) in its method's colour, a dot for each step."""
    from matplotlib.patheffects import Normal, Stroke

    axes.plot(
        *route.T, color=colour_of(method), linewidth=width, marker="o", markersize=1.8 * width, alpha=alpha,
        solid_capstyle="round", path_effects=[Stroke(linewidth=2 * width, foreground="white", alpha=0.5), Normal()], zorder=3,
    )  # fmt: skip


def draw_start(axes: Axes, params: NavigationParams) -> None:
    """Where every route begins."""
    axes.plot(*np.asarray(params.start), zorder=4, **START)


def draw_heat(figure: Figure, axes: Axes, values: np.ndarray, params: NavigationParams) -> None:
    """Values over the arena, as colours of asinh((value - median) / spread).

    Next to the goal and the pit they are a hundred times those elsewhere; asinh shows both.
    """
    from matplotlib.colors import FuncNorm

    low, middle, high = np.nanpercentile(values, [0.5, 50, 99.5])
    spread = np.nanpercentile(np.abs(values - middle), 50) + 1e-6
    forward, back = lambda x: np.arcsinh((x - middle) / spread), lambda y: middle + spread * np.sinh(y)
    norm = FuncNorm((forward, back), vmin=low, vmax=max(high, low + 1e-6), clip=True)
    extent = (0, *np.asarray(params.size), 0)  # left, right, bottom, top: y downwards
    image = axes.imshow(values, extent=extent, cmap="cividis", norm=norm, interpolation="nearest", zorder=0)
    draw_map(axes, params, heat=True)
    ticks = back(np.linspace(forward(low), forward(high), 5))
    bar = figure.colorbar(image, ax=axes, shrink=0.85, pad=0.02, ticks=ticks)
    bar.ax.set_yticks(ticks, [f"{tick:.2g}" if abs(tick) < 10 else f"{tick:.0f}" for tick in ticks])
    bar.ax.minorticks_off()
    bar.outline.set_visible(False)
    bar.ax.tick_params(labelsize=7, colors=QUIET, labelcolor=INK)
