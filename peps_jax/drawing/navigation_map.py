"""Navigation domains as the paper draws them, routes on them, and values over them."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from peps_envs.navigation import NavigationParams
from peps_jax.drawing.panels import INK, QUIET, colour_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

FLOOR = "#fbfaf7"
GROUND = {
    "wall": "#4a4a4a",
    "pit": "#9c5a33",
    "goal": "#57a773",
    "ice": "#a9d3f0",
    "sand": "#f6e3a1",
    "firm sand": "#dfb94f",
}
FIRM = 0.5  # gain on sand from which it is drawn as in the paper's D4, darker: the agent can walk on it


def draw_map(axes: Axes, params: NavigationParams, heat: bool = False) -> None:
    """A domain as the paper draws it, y downwards: walls dark grey, pit brown, goal green, ice blue, sand yellow.

    On a `heat` map ice and sand are outlines, for the heat to be seen.
    """
    from matplotlib.patches import Rectangle
    from matplotlib.patheffects import Normal, Stroke

    width, height = np.asarray(params.size)
    sand = "firm sand" if params.sand_gain >= FIRM else "sand"
    areas = [("ice", params.ice), (sand, params.sand), ("pit", params.pit), ("goal", params.goal)]
    areas += [("wall", wall) for wall in np.asarray(params.walls)]
    outline = dict(fill=False, edgecolor=INK, linewidth=0.9, linestyle=(0, (3, 2)))
    if not heat:
        axes.add_patch(Rectangle((0, 0), width, height, facecolor=FLOOR, linewidth=0, zorder=0))
    for ground, area in areas:
        x0, y0, x1, y1 = np.asarray(area)
        if x1 <= 0 or y1 <= 0:
            continue  # nowhere
        seen_through = heat and ground not in ("wall", "pit", "goal")
        style = outline if seen_through else dict(facecolor=GROUND[ground], linewidth=0)
        axes.add_patch(Rectangle((x0, y0), x1 - x0, y1 - y0, zorder=2 if seen_through else 1, **style))
        if heat and ground != "wall":
            place = ((x0 + x1) / 2, (y0 + y1) / 2)
            halo = [Stroke(linewidth=1.6, foreground=INK, alpha=0.7), Normal()]  # for it to be read on every colour
            text = dict(ha="center", va="center", fontsize=7, color="white", path_effects=halo)
            axes.text(*place, ground.split()[-1], zorder=3, **text)
    axes.set(xlim=(-0.12, width + 0.12), ylim=(height + 0.12, -0.12), aspect="equal", xticks=[], yticks=[])
    axes.set_facecolor(GROUND["wall"])
    for spine in axes.spines.values():
        spine.set(color=GROUND["wall"], linewidth=2.5)


def draw_route(axes: Axes, route: np.ndarray, method: str, alpha: float, width: float = 1.2) -> None:
    """A route (steps + 1, 2) in its method's colour, a dot for each step."""
    from matplotlib.patheffects import Normal, Stroke

    axes.plot(
        *route.T, color=colour_of(method), linewidth=width, marker="o", markersize=1.8 * width, alpha=alpha,
        solid_capstyle="round", path_effects=[Stroke(linewidth=2 * width, foreground="white", alpha=0.5), Normal()], zorder=3,
    )  # fmt: skip


def draw_start(axes: Axes, params: NavigationParams) -> None:
    """Where every route begins."""
    start = dict(marker="o", markersize=7, color="white", markeredgecolor=INK, markeredgewidth=1.3)
    axes.plot(*np.asarray(params.start), zorder=4, **start)


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
