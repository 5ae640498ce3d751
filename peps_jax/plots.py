"""Pictures of a sweep, from its finished rows. matplotlib is imported on the first one drawn.

Each function makes one figure, or returns None where it has nothing to show; `draw` writes all of them into a folder.
"""

from __future__ import annotations

import functools
import io
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np

from peps_envs.navigation import Navigation, NavigationParams, NavigationState
from peps_jax import files, methods
from peps_jax.config import Config
from peps_jax.parts import human, surrogate
from peps_jax.results import PICTURES, Row
from peps_jax.train import Result

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

GROUND = {
    "wall": "#4a4a4a",
    "pit": "#9c5a33",
    "goal": "#57a773",
    "ice": "#a9d3f0",
    "sand": "#f6e3a1",
    "firm sand": "#dfb94f",
}
FLOOR, INK, QUIET = "#fbfaf7", "#2b2b2b", "#8a8a8a"
COLOURS = (
    "#c2255c",
    "#1c6dd0",
    "#e8890c",
    "#2f9e78",
    "#7048b6",
    "#5c6770",
)  # of methods, in the order they are registered
DOTS = 200  # per inch
FIRM = 0.5  # gain on sand from which it is drawn as in the paper's D4, darker: the agent can walk on it
DIRECTIONS = 16  # of full steps, over which the heat maps take the mean


def panels_of(rows: int, columns: int, width: float, height: float) -> tuple[Figure, np.ndarray]:
    """A figure of panels `width` x `height` inches. Without pyplot: no display is asked for, and nothing is global."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(columns * width, rows * height), layout="constrained", facecolor="white")
    FigureCanvasAgg(figure)
    return figure, figure.subplots(rows, columns, squeeze=False)


def tidy(axes: Axes) -> None:
    """No box, quiet ticks, a faint grid behind."""
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color(QUIET)
    axes.tick_params(colors=QUIET, labelcolor=INK, labelsize=8)
    axes.grid(color="#ececec", linewidth=0.8)
    axes.set_axisbelow(True)


def colour_of(method: str) -> str:
    """A method's colour, the same in every figure."""
    return COLOURS[list(methods.METHODS).index(method) % len(COLOURS)]


def _good(rows: Sequence[Row]) -> list[Row]:
    return [row for row in rows if not row.finished.failed]


def _values(rows: Sequence[Row], key: Callable[[Row], Any]) -> list[Any]:
    return list(dict.fromkeys(key(row) for row in rows))


def _middle_lam(rows: Sequence[Row]) -> float:
    """One lambda stands for a grid of them where there is room for one: the middle of those that were swept."""
    lams = sorted({row.cell.lam for row in rows})
    return lams[len(lams) // 2]


def _of_method(rows: Sequence[Row], env: str, method: str, lam: float) -> list[Row]:
    return [row for row in rows if (row.cell.env, row.cell.method, row.cell.lam) == (env, method, lam)]


# --- curves ---------------------------------------------------------------------------------------------------------------


def _smooth(values: np.ndarray, width: int) -> np.ndarray:
    """Mean over the last `width` rounds (rounds,); nan where no episode ended in any of them."""
    seen = np.isfinite(values)
    recent = lambda numbers: np.convolve(numbers, np.ones(width))[: len(numbers)]
    count = recent(seen.astype(float))
    return np.where(count > 0.5, recent(np.where(seen, values, 0.0)) / np.maximum(count, 1), np.nan)


def learning_curves(rows: Sequence[Row]) -> Figure | None:
    """Return and explicability of the episodes that ended, over environment steps: mean and range over seeds."""
    rows = _good(rows)
    if not rows:
        return None
    envs, lam = _values(rows, lambda row: row.cell.env), _middle_lam(rows)
    figure, panels = panels_of(2, len(envs), 3.6, 2.3)
    for column, env in enumerate(envs):
        for line, (curve, title) in enumerate((("return_", "return"), ("explicability", "explicability"))):
            axes = panels[line, column]
            tidy(axes)
            shown = []
            for method in _values(rows, lambda row: row.cell.method):
                members = _of_method(rows, env, method, lam)
                if members:
                    shown.append(_curve(axes, members, curve))
            shown = np.concatenate(shown)
            if shown.size:  # the first, random rounds may be far below all that follows
                bottom = max(axes.get_ylim()[0], shown.min() - 0.25 * (np.ptp(shown) + 10))
                axes.set_ylim(bottom, shown.max() + 0.08 * (shown.max() - bottom) + 1e-6)
            else:
                axes.text(0.5, 0.5, "no episode ended", transform=axes.transAxes, ha="center", color=QUIET, fontsize=8)
            if line == 0:
                axes.set_title(env, color=INK, fontsize=11)
            else:
                axes.set_xlabel("environment steps (thousands)", color=INK, fontsize=9)
            if column == 0:
                axes.set_ylabel(title, color=INK, fontsize=9)
    panels[0, 0].legend(frameon=False, fontsize=8, loc="lower right")
    return figure


def _curve(axes: Axes, members: Sequence[Row], curve: str) -> np.ndarray:
    """One method's line and band; returns the line without its first fifth."""
    config = members[0].finished.result.config
    width = max(1, config.num_rounds // 15)
    seeds = np.stack([_smooth(row.finished.result.curves[curve], width) for row in members])
    places = np.flatnonzero(np.isfinite(seeds).any(0))
    mean, low, high = (reduce(seeds[:, places], 0) for reduce in (np.nanmean, np.nanmin, np.nanmax))
    steps = (places + 1) * config.steps_per_round / 1000
    colour = colour_of(members[0].cell.method)
    axes.fill_between(steps, low, high, color=colour, alpha=0.16, linewidth=0)
    axes.plot(steps, mean, color=colour, linewidth=1.8, label=_label(members[0].cell.method, members[0].cell.lam))
    return mean[len(mean) // 5 :]


def _label(method: str, lam: float) -> str:
    return f"{method}, λ = {lam:g}" if methods.get(method).uses_lam else method


def frontier(rows: Sequence[Row]) -> Figure | None:
    """Explicability against return, a point for each lambda: mean and standard deviation over seeds, and the seeds themselves."""
    rows = _good(rows)
    if not rows:
        return None
    envs = _values(rows, lambda row: row.cell.env)
    figure, panels = panels_of(1, len(envs), 3.6, 3.1)
    for axes, env in zip(panels[0], envs, strict=True):
        tidy(axes)
        for method in _values(rows, lambda row: row.cell.method):
            lams = _values(
                [row for row in rows if (row.cell.env, row.cell.method) == (env, method)], lambda row: row.cell.lam
            )
            if not methods.get(method).uses_lam:
                lams = lams[:1]  # all rows are the same trainings
            _frontier_line(axes, [_of_method(rows, env, method, lam) for lam in sorted(lams)], method)
        axes.margins(0.15)
        axes.set_title(env, color=INK, fontsize=11)
        axes.set_xlabel("return", color=INK, fontsize=9)
    panels[0, 0].set_ylabel("explicability", color=INK, fontsize=9)
    panels[0, 0].legend(frameon=False, fontsize=8)
    return figure


def _frontier_line(axes: Axes, points: Sequence[Sequence[Row]], method: str) -> None:
    """One method's points, in the order of lambda, joined by a line."""
    if not points:
        return
    score = lambda row: (np.mean(row.finished.evaluation.return_), np.mean(row.finished.evaluation.explicability))
    seeds = [np.array([score(row) for row in members]) for members in points]
    means, spreads = np.array([s.mean(0) for s in seeds]), np.array([s.std(0) for s in seeds])
    colour = colour_of(method)
    axes.scatter(*np.concatenate(seeds).T, s=9, color=colour, alpha=0.3, linewidth=0, zorder=2)
    axes.errorbar(
        *means.T, xerr=spreads[:, 0], yerr=spreads[:, 1], color=colour, linewidth=1.2, elinewidth=0.8, marker="o",
        markersize=6, markeredgecolor="white", label=method, zorder=3,
    )  # fmt: skip
    if methods.get(method).uses_lam:
        for members, place in zip(points, means, strict=True):
            name = f"λ = {members[0].cell.lam:g}"
            axes.annotate(name, place, (0, 7), textcoords="offset points", ha="center", fontsize=7, color=INK)


# --- maps -----------------------------------------------------------------------------------------------------------------


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


def _navigates(row: Row) -> bool:
    return isinstance(row.finished.result.config.task()[0], Navigation)


def routes(rows: Sequence[Row], episodes: int = 3) -> Figure | None:
    """Evaluation routes on the map, a column for each method and lambda: the first `episodes` of every seed."""
    rows = [row for row in _good(rows) if _navigates(row)]
    if not rows:
        return None
    variant = lambda row: (row.cell.method, row.cell.lam if methods.get(row.cell.method).uses_lam else None)
    variants, envs = _values(rows, variant), _values(rows, lambda row: row.cell.env)
    figure, panels = panels_of(len(envs), len(variants), 2.5, 2.5)
    for line, env in enumerate(envs):
        for column, (method, lam) in enumerate(variants):
            members = {row.cell.training: row for row in rows if row.cell.env == env and variant(row) == (method, lam)}
            axes = panels[line, column]
            if not members:
                axes.set_axis_off()
                continue
            _routes_panel(axes, list(members.values()), episodes)
            if line == 0:
                axes.set_title(method if lam is None else _label(method, lam), color=INK, fontsize=10)
            if column == 0:
                axes.set_ylabel(env, color=INK, fontsize=10)
    return figure


def _routes_panel(axes: Axes, members: Sequence[Row], episodes: int) -> None:
    draw_map(axes, members[0].finished.result.config.task()[1])
    for row in members:
        evaluation = row.finished.evaluation
        for route, length in zip(evaluation.perceived[:episodes], evaluation.length[:episodes], strict=True):
            draw_route(axes, route[: int(length) + 1], row.cell.method, max(0.35, 1 / len(members) ** 0.5))
    draw_start(axes, members[0].finished.result.config.task()[1])


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


def surrogate_values(result: Result, resolution: int = 61) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """What r_hat says and what the human feels, over positions: mean over full steps in `DIRECTIONS` directions.

    Returns:
      learned: (resolution, resolution) r_hat, over y and x.
      true: (resolution, resolution) E[l_H(s'|s,a) + r_H(s,a,s')] in the true dynamics.
      free: (resolution, resolution) bool, whether an episode can be at the position and go on.
    """
    config = result.config
    environment, params, belief = config.task()
    ticks = (np.arange(resolution) + 0.5) / resolution
    positions = jnp.asarray(np.stack(np.meshgrid(ticks, ticks), -1).reshape(-1, 2), jnp.float32) * params.size[None]
    angles = 2 * np.pi * np.arange(DIRECTIONS) / DIRECTIONS
    actions = jnp.asarray(np.stack([np.cos(angles), np.sin(angles)], -1), jnp.float32)
    numbers = config.replace(seed=0, params=params, belief=belief)  # leaves of one kind for every cell: one program
    learned, true = _surrogate_values(environment, numbers, result.knowledge.surrogate, positions, actions)
    places, shape = np.asarray(positions), (resolution, resolution)
    within = lambda area: np.all((places >= np.asarray(area)[:2]) & (places <= np.asarray(area)[2:]), -1)
    ended = np.any([within(area) for area in (params.pit, params.goal, *params.walls)], 0)
    return np.asarray(learned).reshape(shape), np.asarray(true).reshape(shape), ~ended.reshape(shape)


@functools.partial(jax.jit, static_argnums=0)
def _surrogate_values(environment: Navigation, config: Config, state: Any, positions: Any, actions: Any) -> Any:
    _, params, belief = config.task()

    def at(position: Any, action: Any) -> tuple[Any, Any]:
        before = NavigationState(position, jnp.zeros((), jnp.int32))
        weights, places = environment.next_state_distribution(before, action, params).quadrature(3)
        after = jax.vmap(lambda place: NavigationState(place, jnp.ones((), jnp.int32)))(places)
        weigh = lambda after: sum(human.log_weight(environment, belief, before, action, after))
        learned = surrogate.predict(state, environment.observe(before, params), action, config)
        return learned, weights @ jax.vmap(weigh)(after)

    values = jax.vmap(jax.vmap(at, in_axes=(None, 0)), in_axes=(0, None))(positions, actions)
    return jax.tree.map(lambda value: value.mean(-1), values)


def rank_correlation(a: np.ndarray, b: np.ndarray) -> float:
    """Spearman's, without ties."""
    ranks = [np.argsort(np.argsort(values)) for values in (a, b)]
    return float(np.corrcoef(*ranks)[0, 1])


def surrogate_maps(rows: Sequence[Row]) -> Figure | None:
    """r_hat as a heat map beside the true l_H + r_H, for the first seed of each world and method that learned one."""
    rows = [row for row in _good(rows) if _navigates(row) and hasattr(row.finished.result.knowledge, "surrogate")]
    if not rows:
        return None
    lam = _middle_lam(rows)
    first: dict[tuple[str, str], Row] = {}
    for row in rows:
        if row.cell.lam == lam:
            first.setdefault((row.cell.env, row.cell.method), row)
    figure, panels = panels_of(len(first), 2, 3.3, 2.75)
    for line, ((env, method), row) in enumerate(first.items()):
        learned, true, free = surrogate_values(row.finished.result)
        params = row.finished.result.config.task()[1]
        agreement = rank_correlation(learned[free], true[free])
        titles = (f"learned r̂  (rank correlation {agreement:.2f})", "true ℓ_H + r_H")
        for axes, values, title in zip(panels[line], (learned, true), titles, strict=True):
            draw_heat(figure, axes, np.where(free, values, np.nan), params)
            axes.set_title(title, color=INK, fontsize=9)
        panels[line, 0].set_ylabel(f"{env}, {method}, seed {row.cell.seed}", color=INK, fontsize=9)
    return figure


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


def draw(rows: Sequence[Row], folder: Path) -> list[Path]:
    """Writes every picture that `rows` have something for. Raises NotWrittenError."""
    written = []
    for name, make in zip(PICTURES, (learning_curves, frontier, routes, surrogate_maps), strict=True):
        figure = make(rows)
        if figure is not None:
            picture = io.BytesIO()
            figure.savefig(picture, dpi=DOTS, format="png")
            files.write_whole(folder / name, picture.getvalue())
            written.append(folder / name)
    return written
