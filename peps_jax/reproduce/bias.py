"""How wrong the human is: explicability and return over the strength of the belief's error, from none to twice the preset's."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from peps_jax.drawing.panels import INK, colour_of, legend_below, panels_of, tidy
from peps_jax.reproduce.plan import DOMAINS, FEW_SEEDS, Need, Plan
from peps_jax.reproduce.summary import (
    SCORES,
    TITLES,
    Line,
    decimal,
    estimates,
    from_columns,
    mean,
    title,
    with_interval,
    write_picture,
    write_texts,
)
from peps_jax.storage.tables import markdown

ABOUT = "explicability over the strength of the belief's error"
STRENGTHS = (0.0, 0.5, 1.0, 1.5, 2.0)  # of the belief's error; 1 is the preset
METHODS = ("peps", "sac", "oracle")
_NOTE = """\
Strength 0 is a human who knows the truth, 1 the preset, 2 one who errs twice as far. Interquartile means over up to {seeds} seeds
with a 95 % interval; the planner knows everything.
"""


def needs(plan: Plan) -> list[Need]:
    """Every method and the planner at every strength, with few seeds."""
    plans = [plan.planned(domain, "peps", bias=bias) for domain in DOMAINS for bias in STRENGTHS]
    return plans + [
        training
        for domain in DOMAINS
        for method in METHODS
        for bias in STRENGTHS
        for training in plan.trainings(domain, method, FEW_SEEDS, bias=bias)
    ]


def write(plan: Plan, folder: Path) -> list[Path]:
    """bias.{md,csv,png,pdf}."""
    lines = [
        made
        for domain in DOMAINS
        for bias in STRENGTHS
        for made in (*_learned(plan, domain, bias), _best(plan, domain, bias))
    ]
    return [*write_picture(_picture(lines), lines, folder, "bias"), *write_texts(folder, {"bias.md": _table(lines)})]


def _learned(plan: Plan, domain: str, bias: float) -> list[Line]:
    lines = []
    for method in METHODS:
        records = plan.records(plan.trainings(domain, method, FEW_SEEDS, bias=bias))
        made = {"domain": domain, "method": method, "bias": bias}
        made["arrived"] = mean([record.mean("goal_reached") for record in records])
        lines.append(made | estimates(records))
    return lines


def _best(plan: Plan, domain: str, bias: float) -> Line:
    record = plan.record(plan.planned(domain, "peps", bias=bias))
    scores = {score: record.mean(score) for score in SCORES}
    return {"domain": domain, "method": "planner", "bias": bias, "arrived": record.mean("goal_reached")} | scores


def _picture(lines: list[Line]) -> Any:
    figure, panels = panels_of(len(SCORES), len(DOMAINS), 2.9, 2.3)
    for column, domain in enumerate(DOMAINS):
        for row, score in enumerate(reversed(SCORES)):
            axes = panels[row, column]
            tidy(axes)
            seen = []
            for method in (*METHODS, "planner"):
                own = [line for line in lines if (line["domain"], line["method"]) == (domain, method)]
                planned = method == "planner"
                style = dict(color=INK, linestyle=(0, (4, 3)), linewidth=1.0) if planned else dict(
                    color=colour_of(method), marker="o", markersize=4, linewidth=1.6
                )  # fmt: skip
                values = [line[score] for line in own]
                axes.plot([line["bias"] for line in own], values, label=TITLES.get(method, method), **style)
                seen += values
            # whoever loses the task is far below, and stands in the table
            top = max(seen)
            axes.set_ylim(max(min(seen), top - 25) - 1, top + 1)
            axes.set_xticks(STRENGTHS, [f"{bias:g}" for bias in STRENGTHS])
            if column == 0:
                axes.set_ylabel(score, color=INK, fontsize=9)
        panels[0, column].set_title(title(domain), color=INK, fontsize=11)
        panels[1, column].set_xlabel("strength of the belief's error", color=INK, fontsize=9)
    legend_below(figure, panels[0, 0])
    return figure


def _table(lines: list[Line]) -> str:
    rows = []
    for line in lines:
        shown = [with_interval(from_columns(line, s)) if "seeds" in line else decimal(line[s]) for s in SCORES]
        told = TITLES.get(line["method"], line["method"])
        rows.append([title(line["domain"]), f"{line['bias']:g}", told, decimal(line["arrived"], 2), *shown])
    head = ["domain", "strength", "method", "arrived", *SCORES]
    return "\n".join([markdown(head, rows), _NOTE.format(seeds=FEW_SEEDS)])
