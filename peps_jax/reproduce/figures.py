"""Figures 1 and 2, the frontier and the queries: PNG and PDF, and the numbers behind them as CSV."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

import peps_envs
from peps_jax.analysis.intervals import Estimate
from peps_jax.analysis.surrogate_maps import rank_correlation
from peps_jax.drawing.navigation_map import draw_heat, draw_map, draw_route, draw_start
from peps_jax.drawing.panels import INK, QUIET, colour_of, panels_of, save, tidy
from peps_jax.reproduce.store import Record
from peps_jax.reproduce.tables import SCORES, TITLES, Line, interval, with_interval
from peps_jax.reproduce.trainings import BASELINES, DOMAINS, FEW_SEEDS, METHODS, Planned, Study, Training
from peps_jax.storage import files
from peps_jax.storage.tables import csv_bytes, markdown

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

LAMS = (0.0, 0.5, 1.0, 4.0)  # at which PEPS is trained for the frontier, beside the study's
PLANNED_LAMS = (0.0, 0.25, 0.5, 1.0, 2.0, 4.0, 8.0)  # of the planner's curve, beside the study's
QUERY_DOMAINS = ("nav-d1", "nav-d2", "nav-d4")  # where there is explicability to gain
STRATEGIES = {"information_gain": "#c2255c", "disagreement": "#1c6dd0", "random": "#5c6770"}  # their colours
SHARES = (30, 10, 3, 1)  # of the study's queries, one in so many
QUERY_SEEDS = 5  # what tells one strategy from another is small
REACHED = 0.9  # of the way from SAC's to the planner's explicability: how many queries does it take?


def _save(figure: Figure, lines: Sequence[Line], folder: Path, name: str) -> list[Path]:
    """Writes name.{csv,png,pdf}."""
    files.write_whole(folder / f"{name}.csv", csv_bytes(lines))
    return [folder / f"{name}.csv", *save(figure, folder, name, ("png", "pdf"))]


def _title(domain: str) -> str:
    return domain.removeprefix("nav-").upper()


def _explicability(record: Record) -> float:
    return record.mean("explicability")


# --- Figure 1 -------------------------------------------------------------------------------------------------------------


def figure1_needs(study: Study) -> list[Training | Planned]:
    """PEPS in all domains."""
    return [cell for domain in DOMAINS for cell in study.trainings(domain, "peps")]


def figure1(study: Study, folder: Path) -> list[Path]:
    """What PEPS learned as r-hat, above the true l_H + r_H: of the seed whose explicability is nearest to the median."""
    figure, panels = panels_of(2, len(DOMAINS), 3.0, 2.6)
    lines = []
    for column, domain in enumerate(DOMAINS):
        training = study.typical(study.trainings(domain, "peps"), _explicability)
        if training is None:
            for axes in panels[:, column]:
                axes.set_axis_off()
            continue
        params = peps_envs.make(domain).params
        heat = study.record(training).heat
        free = heat["free"]
        agreement = rank_correlation(heat["learned"][free], heat["true"][free])
        for axes, name in zip(panels[:, column], ("learned", "true"), strict=True):
            draw_heat(figure, axes, np.where(free, heat[name], np.nan), params)
        panels[0, column].set_title(_title(domain), color=INK, fontsize=11)
        panels[0, column].set_xlabel(f"rank correlation {agreement:.2f}", color=INK, fontsize=8)
        lines += _heat_lines(domain, training.config.seed, heat, np.asarray(params.size))
    for axes, text in zip(panels[:, 0], ("learned r̂", "true ℓ_H + r_H"), strict=True):
        axes.set_ylabel(text, color=INK, fontsize=10)
    return _save(figure, lines, folder, "figure1")


def _heat_lines(domain: str, seed: int, heat: dict[str, np.ndarray], size: np.ndarray) -> list[Line]:
    rows, columns = heat["free"].shape
    lines = []
    for row, column in np.argwhere(heat["free"]):
        place = (np.array([column, row]) + 0.5) / (columns, rows) * size
        values = {name: round(float(heat[name][row, column]), 4) for name in ("learned", "true")}
        x, y = (round(float(value), 4) for value in place)
        lines.append({"domain": domain, "seed": seed, "x": x, "y": y} | values)
    return lines


# --- Figure 2 -------------------------------------------------------------------------------------------------------------


def figure2_needs(study: Study) -> list[Training | Planned]:
    """All methods in all domains."""
    return [cell for domain in DOMAINS for method in METHODS for cell in study.trainings(domain, method)]


def figure2(study: Study, folder: Path) -> list[Path]:
    """Rollouts, a column for each method: one of every seed, and boldly the seed whose explicability is nearest to the median."""
    figure, panels = panels_of(len(DOMAINS), len(METHODS), 2.1, 2.1)
    lines = []
    for row, domain in enumerate(DOMAINS):
        params = peps_envs.make(domain).params
        for axes, method in zip(panels[row], METHODS, strict=True):
            draw_map(axes, params)
            trainings = study.trainings(domain, method)
            typical = study.typical(trainings, _explicability)
            for training in sorted(trainings, key=lambda training: training is typical):  # the bold one last, on top
                record = study.record(training)
                if record.failed:
                    continue
                route = record.routes[0][: int(record.mode["length"][0]) + 1]
                bold = training == typical
                draw_route(axes, route, method, alpha=1.0 if bold else 0.3, width=1.5 if bold else 0.8)
                told = {"domain": domain, "method": method, "seed": training.config.seed, "typical": bold}
                lines += [
                    told | {"step": step, "x": x, "y": y} for step, (x, y) in enumerate(np.round(route, 4).tolist())
                ]
            draw_start(axes, params)
            if row == 0:
                axes.set_title(TITLES[method], color=INK, fontsize=11)
        panels[row, 0].set_ylabel(_title(domain), color=INK, fontsize=11)
    return _save(figure, lines, folder, "figure2")


# --- the frontier ---------------------------------------------------------------------------------------------------------


def _lams(study: Study, others: Sequence[float]) -> list[float]:
    return sorted({*others, float(study.base.lam)})


def frontier_needs(study: Study) -> list[Training | Planned]:
    """PEPS over lambda and the baselines, with few seeds, and the planner over lambda."""
    plans = [study.planned(domain, "peps", lam) for domain in DOMAINS for lam in _lams(study, PLANNED_LAMS)]
    peps = [
        cell
        for domain in DOMAINS
        for lam in _lams(study, LAMS)
        for cell in study.trainings(domain, "peps", FEW_SEEDS, lam=lam)
    ]
    others = [cell for domain in DOMAINS for method in BASELINES for cell in study.trainings(domain, method, FEW_SEEDS)]
    return plans + peps + others


def frontier(study: Study, folder: Path) -> list[Path]:
    """Explicability against return: the planner's exact curve, PEPS over lambda, and the baselines."""
    figure, panels = panels_of(1, len(DOMAINS), 3.3, 3.1)
    lines = []
    for axes, domain in zip(panels[0], DOMAINS, strict=True):
        own = [_plan_point(study, domain, lam) for lam in _lams(study, PLANNED_LAMS)]
        own += [_point(study, domain, "peps", lam) for lam in _lams(study, LAMS)]
        own += [_point(study, domain, method, None) for method in BASELINES]
        own = [point for point in own if np.isfinite(point["return"])]
        _frontier_panel(axes, own)
        axes.set_title(_title(domain), color=INK, fontsize=11)
        axes.set_xlabel("return", color=INK, fontsize=9)
        lines += own
    panels[0, 0].set_ylabel("explicability", color=INK, fontsize=9)
    handles = {
        text: handle for axes in panels[0] for handle, text in zip(*axes.get_legend_handles_labels(), strict=True)
    }
    figure.legend(handles.values(), handles.keys(), frameon=False, fontsize=8, loc="outside lower center", ncols=5)
    return _save(figure, lines, folder, "frontier")


def _plan_point(study: Study, domain: str, lam: float) -> Line:
    record = study.record(study.planned(domain, "peps", lam))
    return {"domain": domain, "method": "planner", "lam": lam} | {score: record.mean(score) for score in SCORES}


def _point(study: Study, domain: str, method: str, lam: float | None) -> Line:
    """Interquartile means over the seeds, with their intervals."""
    changes = {} if lam is None else {"lam": lam}
    records = study.records(study.trainings(domain, method, FEW_SEEDS, **changes))
    return {"domain": domain, "method": method, "lam": lam} | _estimates(records)


def _estimates(records: Sequence[Record]) -> Line:
    made: Line = {"seeds": len(records)}
    for score in SCORES:
        found = interval([[record.mean(score) for record in records]])
        made |= {score: found.value, f"{score}_low": found.low, f"{score}_high": found.high}
    return made


def _frontier_panel(axes: Axes, points: Sequence[Line]) -> None:
    """Limits hold the planner's curve and PEPS; what is far below is named at the edge."""
    tidy(axes)
    inner = [point for point in points if point["method"] in ("planner", "sac")]
    limits = {}
    for score in SCORES:
        values = [point[score] for point in inner]
        room = 0.6 * (max(values) - min(values)) + 2.0
        limits[score] = (min(values) - room, max(values) + 0.4 * room)
    axes.set(xlim=limits["return"], ylim=limits["explicability"])
    seen = lambda point: all(low <= point[score] <= high for score, (low, high) in limits.items())
    curve = sorted((point for point in points if point["method"] == "planner"), key=lambda point: point["lam"])
    places = np.array([[point[score] for score in SCORES] for point in curve])
    axes.plot(*places.T, color=QUIET, linewidth=1.2, marker="D", markersize=3.5, label="planner", zorder=2)
    hidden = []
    for method in ("peps", *BASELINES):
        own = [point for point in points if point["method"] == method]
        visible = [point for point in own if seen(point)]
        hidden += [point for point in own if not seen(point)]
        label = TITLES[method]
        for point in visible:
            spread = [
                [[point[score] - point[f"{score}_low"]], [point[f"{score}_high"] - point[score]]] for score in SCORES
            ]
            axes.errorbar(
                point["return"], point["explicability"], xerr=spread[0], yerr=spread[1], color=colour_of(method),
                marker="o", markersize=6, markeredgecolor="white", elinewidth=0.8, linewidth=0, label=label, zorder=3,
            )  # fmt: skip
            label = None
        if method == "peps":
            places = np.array([[point[score] for score in SCORES] for point in visible]).reshape(-1, 2)
            axes.plot(*places.T, color=colour_of(method), linewidth=1.0, alpha=0.6, zorder=2)
            sizes = [high - low for low, high in limits.values()]
            for together in _at_one_place(places / sizes):
                told = ", ".join(f"{visible[number]['lam']:g}" for number in together)
                _note(axes, told, places[together[0]])
    for number, point in enumerate(hidden):
        lam = f" λ = {point['lam']:g}" if point["lam"] is not None else ""
        text = f"↙ {TITLES[point['method']]}{lam} ({point['return']:.0f}, {point['explicability']:.0f})"
        colour = colour_of(point["method"])
        axes.text(0.03, 0.03 + 0.07 * number, text, transform=axes.transAxes, fontsize=7, color=colour)


def _at_one_place(places: np.ndarray) -> list[list[int]]:
    """Rows of `places` (n, 2), in shares of the axes, that can't be told apart: each with the first one that it is near to."""
    groups: list[list[int]] = []
    for number, place in enumerate(places):
        near = [group for group in groups if np.abs(place - places[group[0]]).max() < 0.06]
        if near:
            near[0].append(number)
        else:
            groups.append([number])
    return groups


def _note(axes: Axes, text: str, place: Any) -> None:
    axes.annotate(text, place, (5, 5), textcoords="offset points", fontsize=7, color=INK)


# --- queries --------------------------------------------------------------------------------------------------------------


def _budgets(study: Study) -> list[int]:
    return sorted({max(1, study.base.num_queries // share) for share in SHARES})


def _asked(study: Study, domain: str, strategy: str, budget: int) -> list[Training]:
    return study.trainings(domain, "peps", QUERY_SEEDS, query_strategy=strategy, num_queries=budget)


def _unasked(study: Study, domain: str) -> list[Training]:
    return study.trainings(domain, "sac", QUERY_SEEDS)


def queries_needs(study: Study) -> list[Training | Planned]:
    """PEPS with every strategy and budget; SAC, which asks nothing; and the planner's bound."""
    plans = [study.planned(domain, "peps") for domain in QUERY_DOMAINS]
    cells = [cell for domain in QUERY_DOMAINS for cell in _unasked(study, domain)]
    for strategy in STRATEGIES:
        for budget in _budgets(study):
            cells += [cell for domain in QUERY_DOMAINS for cell in _asked(study, domain, strategy, budget)]
    return plans + cells


def queries(study: Study, folder: Path) -> list[Path]:
    """queries.{md,csv,png,pdf}: explicability against the number of queries, a line for each strategy."""
    figure, panels = panels_of(1, len(QUERY_DOMAINS), 3.3, 2.8)
    lines = []
    for axes, domain in zip(panels[0], QUERY_DOMAINS, strict=True):
        tidy(axes)
        levels = {
            "planner": (_explicability(study.record(study.planned(domain, "peps"))), INK),
            "SAC": (_estimates(study.records(_unasked(study, domain)))["explicability"], QUIET),
        }
        for name, (level, colour) in levels.items():
            axes.axhline(level, color=colour, linewidth=0.9, linestyle=(0, (4, 3)), label=name)
            lines.append({"domain": domain, "strategy": name, "explicability": level})
        for strategy, colour in STRATEGIES.items():
            own = [_estimates(study.records(_asked(study, domain, strategy, budget))) for budget in _budgets(study)]
            told = [{"domain": domain, "strategy": strategy, "queries": budget} for budget in _budgets(study)]
            lines += [head | made for head, made in zip(told, own, strict=True)]
            value, low, high = (
                [made[name] for made in own] for name in ("explicability", "explicability_low", "explicability_high")
            )
            axes.fill_between(_budgets(study), low, high, color=colour, alpha=0.13, linewidth=0)
            name = strategy.replace("_", " ")
            axes.plot(_budgets(study), value, color=colour, linewidth=1.6, marker="o", markersize=4, label=name)
        base, gap = levels["SAC"][0], levels["planner"][0] - levels["SAC"][0]
        # a training that goes astray is far below: its interval runs out of the picture, and stands in the table
        if gap > 0:
            axes.set_ylim(base - 0.8 * gap, base + 1.2 * gap)
        axes.set_xscale("log")
        axes.set_xticks(_budgets(study), [f"{budget:,}" for budget in _budgets(study)])
        axes.minorticks_off()
        axes.set_title(_title(domain), color=INK, fontsize=11)
        axes.set_xlabel("queries", color=INK, fontsize=9)
    panels[0, 0].set_ylabel("explicability", color=INK, fontsize=9)
    handles, texts = panels[0, 0].get_legend_handles_labels()
    figure.legend(handles, texts, frameon=False, fontsize=8, loc="outside lower center", ncols=len(texts))
    text = folder / "queries.md"
    files.write_whole(text, _queries_table(lines).encode())
    return [*_save(figure, lines, folder, "queries"), text]


def queries_needed(budgets: Sequence[int], values: Sequence[float], target: float) -> float:
    """Where the line through `values` over the logarithm of `budgets` first reaches `target`; inf if it doesn't."""
    above = np.flatnonzero(np.asarray(values) >= target)
    if not above.size:
        return np.inf
    if above[0] == 0:
        return float(budgets[0])
    place = slice(above[0] - 1, above[0] + 1)
    return float(np.exp(np.interp(target, values[place], np.log(budgets[place]))))


def _queries_table(lines: Sequence[Line]) -> str:
    budgets = sorted({line["queries"] for line in lines if "queries" in line})
    rows = []
    for domain in QUERY_DOMAINS:
        own = [line for line in lines if line["domain"] == domain]
        level = {line["strategy"]: line["explicability"] for line in own if "queries" not in line}
        target = level["SAC"] + REACHED * (level["planner"] - level["SAC"])
        for strategy in STRATEGIES:
            points = [line for line in own if line["strategy"] == strategy]
            needed = queries_needed(budgets, [point["explicability"] for point in points], target)
            shown = [
                with_interval(Estimate(*(point[f"explicability{end}"] for end in ("", "_low", "_high"))))
                for point in points
            ]
            told = f"more than {budgets[-1]:,}" if np.isinf(needed) else f"{needed:,.0f}"
            rows.append([_title(domain), strategy.replace("_", " "), *shown, told])
    head = ["domain", "queries chosen by", *(f"{budget:,}" for budget in budgets), f"to {REACHED:.0%} of the way"]
    note = (
        f"Explicability: interquartile mean over up to {QUERY_SEEDS} seeds, with its 95 % interval. Last, how many it takes "
        "for so much of the way from SAC's explicability to the planner's: between the numbers looked at by a straight line "
        "over their logarithm.\n"
    )
    return "\n".join([markdown(head, rows), note])
