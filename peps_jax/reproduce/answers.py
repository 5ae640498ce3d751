"""How many answers it takes: arrival, return and explicability over the number of answers, method by method."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from peps_jax.config import Config
from peps_jax.drawing.panels import INK, QUIET, bound, colour_of, legend_below, panels_of, tidy
from peps_jax.reproduce.plan import DOMAINS, Need, Plan, Training
from peps_jax.reproduce.summary import (
    Line,
    decimal,
    estimates,
    explicability,
    from_columns,
    mean,
    title,
    with_interval,
    write_picture,
    write_texts,
)
from peps_jax.storage.tables import markdown

ABOUT = "arrival, return and explicability over the number of answers"
SEEDS = 20  # a training that loses its task is rare
SHARES = (0, 1 / 3, 1, 10)  # of the plan's queries
VARIANTS: dict[str, tuple[str, dict[str, Any], str]] = {  # method, changes, colour
    "PEPS": ("peps", {}, colour_of("peps")),
    "PEPS, r̂ from nothing": ("peps", {"prior": "none"}, "#e599b5"),
    "DRLHP": ("drlhp", {}, colour_of("drlhp")),
    "policy shaping": ("policy_shaping", {}, colour_of("policy_shaping")),
}
SHOWN = {"explicability": "explicability", "return": "return", "arrived": "share of seeds that arrive"}
APART = 0.06  # between two variants' points at one number of answers, which would hide one another
_NOTE = """\
Arrived: the share of seeds whose mode reaches the goal; scores are interquartile means over up to {seeds} seeds with a 95 %
interval, seeds that don't arrive among them. SAC asks nothing; the planner knows everything.
"""


def budgets(base: Config) -> list[int]:
    """Numbers of answers, from none on."""
    return sorted({round(base.num_queries * share) for share in SHARES})


def _trainings(plan: Plan, domain: str, variant: str, budget: int) -> list[Training]:
    method, changes, _ = VARIANTS[variant]
    return plan.trainings(domain, method, SEEDS, num_queries=budget, **changes)


def _asked(plan: Plan) -> Iterator[tuple[str, int]]:
    """Variants and budgets; with no answer there is nothing but a prior to learn from."""
    for variant in VARIANTS:
        for budget in budgets(plan.base):
            if budget or variant == "PEPS":
                yield variant, budget


def needs(plan: Plan) -> list[Need]:
    """Every variant with every number of answers; SAC, which asks nothing; and the planner's bound."""
    asked = [
        training
        for domain in DOMAINS
        for variant, budget in _asked(plan)
        for training in _trainings(plan, domain, variant, budget)
    ]
    sac = [training for domain in DOMAINS for training in plan.trainings(domain, "sac", SEEDS)]
    return [plan.planned(domain, "peps") for domain in DOMAINS] + sac + asked


def _line(plan: Plan, domain: str, name: str, budget: int, trainings: list[Training]) -> Line:
    records = plan.records(trainings)
    arrived = mean([record.mean("goal_reached") for record in records])
    return {"domain": domain, "method": name, "answers": budget, "arrived": arrived} | estimates(records)


def write(plan: Plan, folder: Path) -> list[Path]:
    """answers.{md,csv,png,pdf}."""
    lines = []
    for domain in DOMAINS:
        lines.append(_line(plan, domain, "SAC", 0, plan.trainings(domain, "sac", SEEDS)))
        for variant, budget in _asked(plan):
            lines.append(_line(plan, domain, variant, budget, _trainings(plan, domain, variant, budget)))
    figure = _picture(plan, lines)
    return [*write_picture(figure, lines, folder, "answers"), *write_texts(folder, {"answers.md": _table(plan, lines)})]


def _picture(plan: Plan, lines: list[Line]) -> Any:
    """A row for each of `SHOWN`, a column for each domain; scores with their intervals."""
    figure, panels = panels_of(len(SHOWN), len(DOMAINS), 2.9, 2.3)
    asked = budgets(plan.base)
    for column, domain in enumerate(DOMAINS):
        own = [line for line in lines if line["domain"] == domain]
        sac = next(line for line in own if line["method"] == "SAC")
        planned = plan.record(plan.planned(domain, "peps"))
        levels = {
            "planner": {"explicability": explicability(planned), "return": planned.mean("return")},
            "SAC": {score: sac[score] for score in ("explicability", "return")},
        }
        for row, (score, words) in enumerate(SHOWN.items()):
            axes = panels[row, column]
            tidy(axes)
            for place, (variant, (_, _, colour)) in enumerate(VARIANTS.items()):
                points = [line for line in own if line["method"] == variant]
                x = [asked.index(line["answers"]) + APART * (place - (len(VARIANTS) - 1) / 2) for line in points]
                _points(axes, x, points, score, dict(color=colour, label=variant))
            axes.set_xticks(range(len(asked)), [f"{budget:,}" for budget in asked])
            if column == 0:
                axes.set_ylabel(words, color=INK, fontsize=9)
            if score != "arrived":
                for (name, level), colour in zip(levels.items(), (INK, QUIET), strict=True):
                    bound(axes, name, level[score], colour)
                axes.set_ylim(*_range(*(level[score] for level in levels.values())))
        panels[0, column].set_title(title(domain), color=INK, fontsize=11)
        panels[-1, column].set_ylim(-0.05, 1.05)
        panels[-1, column].set_xlabel("answers", color=INK, fontsize=9)
    legend_below(figure, panels[0, 0])
    return figure


def _points(axes: Any, x: list[float], points: list[Line], score: str, style: dict[str, Any]) -> None:
    y = [line[score] for line in points]
    axes.plot(x, y, "o-", linewidth=1.6, markersize=4, **style)
    if score != "arrived":
        axes.vlines(x, *([line[f"{score}_{end}"] for line in points] for end in ("low", "high")), color=style["color"],
                    linewidth=1.1)  # fmt: skip


def _range(planner: float, sac: float) -> tuple[float, float]:
    """What of a score is shown: whoever loses the task is far below, and shows in the row of arrivals."""
    gap = max(abs(planner - sac), 4.0) if math.isfinite(sac) else 10.0
    return min(planner, sac) - 0.8 * gap, max(planner, sac) + 0.2 * gap


def _table(plan: Plan, lines: list[Line]) -> str:
    rows = [
        [
            title(line["domain"]), line["method"], f"{line['answers']:,}", decimal(line["arrived"], 2),
            with_interval(from_columns(line, "return")), with_interval(from_columns(line, "explicability")),
        ]
        for line in lines
    ]  # fmt: skip
    head = ["domain", "method", "answers", "arrived", "return", "explicability"]
    return "\n".join([markdown(head, rows), _NOTE.format(seeds=SEEDS)])
