"""Pictures of a sweep, from its finished rows. matplotlib is imported on the first one drawn.

Each function makes one figure, or returns None where it has nothing to show; `draw` writes all of them into a folder.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax
import numpy as np

from peps_envs import Scene
from peps_jax import methods
from peps_jax.analysis import episodes
from peps_jax.analysis.surrogate_maps import has_map, rank_correlation, surrogate_values
from peps_jax.drawing import scenes
from peps_jax.drawing.navigation_map import draw_heat, draw_map, draw_route, draw_start, key_below
from peps_jax.drawing.panels import INK, QUIET, colour_of, panels_of, save, tidy
from peps_jax.sweep.results import PICTURES, Row

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


MOMENTS = 3  # of an episode, in an environment that has a picture of itself


def _good(rows: Sequence[Row]) -> list[Row]:
    return [row for row in rows if not row.run.failed]


def _values(rows: Sequence[Row], key: Callable[[Row], Any]) -> list[Any]:
    return list(dict.fromkeys(key(row) for row in rows))


def _middle_lam(rows: Sequence[Row]) -> float:
    """One lambda stands for a grid of them where there is room for one: the middle of those that were swept."""
    lams = sorted({row.key.lam for row in rows})
    return lams[len(lams) // 2]


def _of_method(rows: Sequence[Row], env: str, method: str, lam: float) -> list[Row]:
    return [row for row in rows if (row.key.env, row.key.method, row.key.lam) == (env, method, lam)]


# --- curves ---------------------------------------------------------------------------------------------------------------


def _smooth(values: np.ndarray, episodes: np.ndarray, width: int) -> np.ndarray:
    """Mean over the last `width` rounds (rounds,); nan where no episode ended in any of them, as `episodes` (rounds,) tells."""
    seen = (episodes > 0) & np.isfinite(values)
    recent = lambda numbers: np.convolve(numbers, np.ones(width))[: len(numbers)]
    count = recent(seen.astype(float))
    return np.where(count > 0.5, recent(np.where(seen, values, 0.0)) / np.maximum(count, 1), np.nan)


def learning_curves(rows: Sequence[Row]) -> Figure | None:
    """Return and explicability of the episodes that ended, over environment steps: mean and range over seeds."""
    rows = _good(rows)
    if not rows:
        return None
    envs, lam = _values(rows, lambda row: row.key.env), _middle_lam(rows)
    figure, panels = panels_of(2, len(envs), 3.6, 2.3)
    for column, env in enumerate(envs):
        for line, (curve, title) in enumerate((("return_", "return"), ("explicability", "explicability"))):
            axes = panels[line, column]
            tidy(axes)
            shown = []
            for method in _values(rows, lambda row: row.key.method):
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
    config = members[0].run.config
    width = max(1, config.num_rounds // 15)
    curves = [row.run.curves for row in members]
    seeds = np.stack([_smooth(own[curve], own["episodes"], width) for own in curves])
    places = np.flatnonzero(np.isfinite(seeds).any(0))
    mean, low, high = (reduce(seeds[:, places], 0) for reduce in (np.nanmean, np.nanmin, np.nanmax))
    steps = (places + 1) * config.steps_per_round / 1000
    colour = colour_of(members[0].key.method)
    axes.fill_between(steps, low, high, color=colour, alpha=0.16, linewidth=0)
    axes.plot(steps, mean, color=colour, linewidth=1.8, label=_label(members[0].key.method, members[0].key.lam))
    return mean[len(mean) // 5 :]


def _label(method: str, lam: float) -> str:
    return f"{method}, λ = {lam:g}" if methods.get(method).uses_lam else method


def frontier(rows: Sequence[Row]) -> Figure | None:
    """Explicability against return, a point for each lambda: mean and standard deviation over seeds, and the seeds themselves."""
    rows = _good(rows)
    if not rows:
        return None
    envs = _values(rows, lambda row: row.key.env)
    figure, panels = panels_of(1, len(envs), 3.6, 3.1)
    for axes, env in zip(panels[0], envs, strict=True):
        tidy(axes)
        for method in _values(rows, lambda row: row.key.method):
            lams = _values(
                [row for row in rows if (row.key.env, row.key.method) == (env, method)], lambda row: row.key.lam
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
    score = lambda row: (np.mean(row.run.evaluation.return_), np.mean(row.run.evaluation.explicability))
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
            name = f"λ = {members[0].key.lam:g}"
            axes.annotate(name, place, (0, 7), textcoords="offset points", ha="center", fontsize=7, color=INK)


# --- what the agents do ---------------------------------------------------------------------------------------------------


def routes(rows: Sequence[Row], episodes: int = 3) -> Figure | None:
    """What the agents do, a row for each environment and a column for each method and lambda.

    In navigation routes on the map, the first `episodes` of every seed; in an environment with a picture of itself moments of one
    episode; elsewhere the perceived state over time, in the same episodes.
    """
    rows = _good(rows)
    if not rows:
        return None
    variant = lambda row: (row.key.method, row.key.lam if methods.get(row.key.method).uses_lam else None)
    variants, envs = _values(rows, variant), _values(rows, lambda row: row.key.env)
    figure, panels = panels_of(len(envs), len(variants), 2.5, 2.5)
    for line, env in enumerate(envs):
        for column, (method, lam) in enumerate(variants):
            members = {row.key.training: row for row in rows if row.key.env == env and variant(row) == (method, lam)}
            axes = panels[line, column]
            if not members:
                axes.set_axis_off()
                continue
            _panel(axes, list(members.values()), episodes)
            if line == 0:
                axes.set_title(method if lam is None else _label(method, lam), color=INK, fontsize=10)
            if column == 0:
                axes.set_ylabel(env, color=INK, fontsize=10)
    maps = [row.run.training.problem.params for row in rows if has_map(row.run)]
    if maps:
        key_below(figure, maps)
    return figure


def _panel(axes: Axes, members: Sequence[Row], episodes: int) -> None:
    """What one method does in one environment, whichever way that can be shown."""
    if has_map(members[0].run):
        _routes_panel(axes, members, episodes)
        return
    shown = _moments(members[0])
    if shown:
        _moments_panel(axes, shown)
    else:
        _perceived_panel(axes, members, episodes)


def _opacity(members: Sequence[Row]) -> float:
    return max(0.35, 1 / len(members) ** 0.5)


def _routes_panel(axes: Axes, members: Sequence[Row], episodes: int) -> None:
    draw_map(axes, members[0].run.training.problem.params)
    for row in members:
        evaluation = row.run.evaluation
        for route, length in zip(evaluation.perceived[:episodes], evaluation.length[:episodes], strict=True):
            draw_route(axes, route[: int(length) + 1], row.key.method, _opacity(members))
    draw_start(axes, members[0].run.training.problem.params)


def _moments(row: Row) -> dict[str, Scene]:
    """Moments of one episode by their times; none of an environment that has no picture."""
    problem = row.run.training.problem
    environment, params = problem.environment, problem.params
    start, _ = environment.reset(jax.random.key(0), params)
    if environment.scene(start, params) is None:
        return {}
    seen = jax.tree.map(np.asarray, episodes.episode(row.run, jax.random.key(0)))
    times = np.linspace(0, int(seen.length), MOMENTS + 1)[1:].round()
    shown = scenes.scenes_of(environment, params, seen.states, times)
    return {f"step {time:.0f}": scene for time, scene in zip(times, shown, strict=True)}


def _moments_panel(axes: Axes, shown: Mapping[str, Scene]) -> None:
    """Scenes below one another, by their times."""
    axes.set(xticks=[], yticks=[])
    for spine in axes.spines.values():
        spine.set_visible(False)
    share = 1 / len(shown)
    for place, (time, scene) in enumerate(shown.items()):
        inset = axes.inset_axes((0.0, 1 - (place + 1) * share, 1.0, 0.9 * share))
        scenes.draw(inset, scene)
        inset.set_title(time, color=QUIET, fontsize=7, loc="left", pad=2)


def _perceived_panel(axes: Axes, members: Sequence[Row], episodes: int) -> None:
    """How far each part of the perceived state is from where it started, in perceptual widths, a style of line for each."""
    tidy(axes)
    problem = members[0].run.training.problem
    width = np.asarray(problem.environment.perception_width(problem.params))
    for row in members:
        evaluation = row.run.evaluation
        for perceived, length in zip(evaluation.perceived[:episodes], evaluation.length[:episodes], strict=True):
            seen = np.asarray(perceived[: int(length) + 1])
            for part, style in zip(((seen - seen[:1]) / width[None]).T, itertools.cycle(("-", "--", ":", "-."))):
                colour = colour_of(row.key.method)
                axes.plot(part, style, color=colour, linewidth=1.2, alpha=_opacity(members))
    axes.set_xlabel("step; perceived state, σ_p from its start", color=QUIET, fontsize=7)


def surrogate_maps(rows: Sequence[Row]) -> Figure | None:
    """r_hat as a heat map beside the true l_H + r_H, for the first seed of each environment and method that learned one."""
    rows = [row for row in _good(rows) if has_map(row.run) and row.run.surrogate is not None]
    if not rows:
        return None
    lam = _middle_lam(rows)
    first: dict[tuple[str, str], Row] = {}
    for row in rows:
        if row.key.lam == lam:
            first.setdefault((row.key.env, row.key.method), row)
    figure, panels = panels_of(len(first), 2, 3.3, 2.75)
    for line, ((env, method), row) in enumerate(first.items()):
        learned, true, free = surrogate_values(row.run)
        params = row.run.training.problem.params
        agreement = rank_correlation(learned[free], true[free])
        titles = (f"learned r̂  (rank correlation {agreement:.2f})", "true ℓ_H + r_H")
        for axes, values, title in zip(panels[line], (learned, true), titles, strict=True):
            draw_heat(figure, axes, np.where(free, values, np.nan), params)
            axes.set_title(title, color=INK, fontsize=9)
        panels[line, 0].set_ylabel(f"{env}, {method}, seed {row.key.seed}", color=INK, fontsize=9)
    return figure


def draw(rows: Sequence[Row], folder: Path) -> list[Path]:
    """Writes every picture that `rows` have something for. Raises NotWrittenError."""
    written = []
    for name, make in zip(PICTURES, (learning_curves, frontier, routes, surrogate_maps), strict=True):
        figure = make(rows)
        if figure is not None:
            written += save(figure, folder, name.removesuffix(".png"))
    return written
