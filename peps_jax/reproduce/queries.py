"""Explicability over the number of queries, a line for each way to choose them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from peps_jax.drawing.panels import INK, QUIET, bound, legend_below, panels_of, tidy
from peps_jax.reproduce.plan import Need, Plan, Training
from peps_jax.reproduce.summary import (
    Line,
    estimates,
    explicability,
    from_columns,
    title,
    with_interval,
    write_picture,
    write_texts,
)
from peps_jax.storage.tables import markdown

ABOUT = "explicability over the number of queries"
QUERY_DOMAINS = ("nav-d1", "nav-d2", "nav-d4")  # where there is explicability to gain
STRATEGIES = {"information_gain": "#c2255c", "disagreement": "#1c6dd0", "random": "#5c6770"}  # their colours
SHARES = (30, 10, 3, 1)  # of the plan's queries, one in so many
QUERY_SEEDS = 5  # what tells one strategy from another is small
REACHED = 0.9  # of the way from SAC's to the planner's explicability: how many queries does it take?


def _budgets(plan: Plan) -> list[int]:
    return sorted({max(1, plan.base.num_queries // share) for share in SHARES})


def _asked(plan: Plan, domain: str, strategy: str, budget: int) -> list[Training]:
    return plan.trainings(domain, "peps", QUERY_SEEDS, query_strategy=strategy, num_queries=budget)


def _unasked(plan: Plan, domain: str) -> list[Training]:
    return plan.trainings(domain, "sac", QUERY_SEEDS)


def needs(plan: Plan) -> list[Need]:
    """PEPS with every strategy and budget; SAC, which asks nothing; and the planner's bound."""
    plans = [plan.planned(domain, "peps") for domain in QUERY_DOMAINS]
    asked = [training for domain in QUERY_DOMAINS for training in _unasked(plan, domain)]
    for strategy in STRATEGIES:
        for budget in _budgets(plan):
            asked += [training for domain in QUERY_DOMAINS for training in _asked(plan, domain, strategy, budget)]
    return plans + asked


def write(plan: Plan, folder: Path) -> list[Path]:
    """queries.{md,csv,png,pdf}: explicability against the number of queries, a line for each strategy."""
    figure, panels = panels_of(1, len(QUERY_DOMAINS), 3.3, 2.8)
    lines = []
    for axes, domain in zip(panels[0], QUERY_DOMAINS, strict=True):
        tidy(axes)
        levels = {
            "planner": (explicability(plan.record(plan.planned(domain, "peps"))), INK),
            "SAC": (estimates(plan.records(_unasked(plan, domain)))["explicability"], QUIET),
        }
        for name, (level, colour) in levels.items():
            bound(axes, name, level, colour)
            lines.append({"domain": domain, "strategy": name, "explicability": level})
        for strategy, colour in STRATEGIES.items():
            own = [estimates(plan.records(_asked(plan, domain, strategy, budget))) for budget in _budgets(plan)]
            told = [{"domain": domain, "strategy": strategy, "queries": budget} for budget in _budgets(plan)]
            lines += [head | made for head, made in zip(told, own, strict=True)]
            value, low, high = (
                [made[name] for made in own] for name in ("explicability", "explicability_low", "explicability_high")
            )
            axes.fill_between(_budgets(plan), low, high, color=colour, alpha=0.13, linewidth=0)
            name = strategy.replace("_", " ")
            axes.plot(_budgets(plan), value, color=colour, linewidth=1.6, marker="o", markersize=4, label=name)
        base, gap = levels["SAC"][0], levels["planner"][0] - levels["SAC"][0]
        # a training that goes astray is far below: its interval runs out of the picture, and stands in the table
        if gap > 0:
            axes.set_ylim(base - 0.8 * gap, base + 1.2 * gap)
        axes.set_xscale("log")
        axes.set_xticks(_budgets(plan), [f"{budget:,}" for budget in _budgets(plan)])
        axes.minorticks_off()
        axes.set_title(title(domain), color=INK, fontsize=11)
        axes.set_xlabel("queries", color=INK, fontsize=9)
    panels[0, 0].set_ylabel("explicability", color=INK, fontsize=9)
    legend_below(figure, panels[0, 0])
    return [*write_picture(figure, lines, folder, "queries"), *write_texts(folder, {"queries.md": _table(lines)})]


def to_reach(sac: float, planner: float) -> float:
    """The explicability at `REACHED` of the way from one to the other."""
    return sac + REACHED * (planner - sac)


def queries_needed(budgets: Sequence[int], values: Sequence[float], target: float) -> float:
    """Where the line through `values` over the logarithm of `budgets` first reaches `target`; inf if it doesn't."""
    above = np.flatnonzero(np.asarray(values) >= target)
    if not above.size:
        return np.inf
    if above[0] == 0:
        return float(budgets[0])
    place = slice(above[0] - 1, above[0] + 1)
    return float(np.exp(np.interp(target, values[place], np.log(budgets[place]))))


def _table(lines: Sequence[Line]) -> str:
    budgets = sorted({line["queries"] for line in lines if "queries" in line})
    rows = []
    for domain in QUERY_DOMAINS:
        own = [line for line in lines if line["domain"] == domain]
        level = {line["strategy"]: line["explicability"] for line in own if "queries" not in line}
        target = to_reach(level["SAC"], level["planner"])
        for strategy in STRATEGIES:
            points = [line for line in own if line["strategy"] == strategy]
            needed = queries_needed(budgets, [point["explicability"] for point in points], target)
            shown = [with_interval(from_columns(point, "explicability")) for point in points]
            told = f"more than {budgets[-1]:,}" if np.isinf(needed) else f"{needed:,.0f}"
            rows.append([title(domain), strategy.replace("_", " "), *shown, told])
    head = ["domain", "queries chosen by", *(f"{budget:,}" for budget in budgets), f"to {REACHED:.0%} of the way"]
    note = (
        f"Explicability: interquartile mean over up to {QUERY_SEEDS} seeds, with its 95 % interval. Last, how many it takes "
        "for so much of the way from SAC's explicability to the planner's: between the numbers looked at by a straight line "
        "over their logarithm.\n"
    )
    return "\n".join([markdown(head, rows), note])
