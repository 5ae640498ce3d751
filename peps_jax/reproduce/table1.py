"""Table 1: return and explicability of every method, beside the paper's and the planner's."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from peps_jax import methods
from peps_jax.reproduce import ways
from peps_jax.reproduce.plan import BASELINES, DOMAINS, Need, Plan, Training
from peps_jax.reproduce.store import Record
from peps_jax.reproduce.summary import (
    SCORES,
    Line,
    cells,
    decimal,
    head,
    improvement_cells,
    improvements,
    line,
    mean,
    percent,
    way_covered,
    write_texts,
)
from peps_jax.storage.tables import csv_bytes, latex, markdown

ABOUT = "return and explicability of every method"
MANY = 10  # times as many answers, in the table after it
ROWS = ("peps", "sac", "drlhp", "policy_shaping", "oracle", "human_expectation")
# Gong and Zhang 2021, Table 1, in the order of `DOMAINS`: averages over 100 rollouts, without intervals
PAPER = {
    "return": {
        "peps": (95.53, 94.07, 96.80, 92.17),
        "sac": (97.46, 95.65, 94.47, 93.27),
        "drlhp": (74.51, 23.28, -50.76, 17.38),
        "policy_shaping": (93.91, 95.55, -178.76, 90.11),
    },
    "explicability": {
        "peps": (94.87, 91.10, 94.72, 92.17),
        "sac": (92.57, 91.00, 91.88, 90.77),
        "drlhp": (73.01, 20.94, -50.79, 17.36),
        "policy_shaping": (89.17, 90.66, -181.46, 90.11),
    },
}
_NOTE = """\
{answers:,} answers. Arrive: seeds whose mode reaches the goal. IQM: interquartile mean over seeds, with a 95 % stratified
bootstrap interval; {episodes} episodes a seed by the policy's mode, "sampled" by its samples. Way: how many seeds go as in the
paper's Figure 2, and the way of the planner. Paper: Gong and Zhang 2021, Table 1. The planner knows dynamics, belief and rewards;
"peps" is Eq. (6) at λ = {lam:g}. "human" acts, and is scored, in the MDP that the human believes in. The oracle is told ℓ_H + r_H
in r̂'s place.
"""


def needs(plan: Plan, many: bool = False) -> list[Need]:
    """All rows in all domains, and the planner's bounds; `many` is the table of `MANY` times as many answers."""
    plans = [plan.planned(domain, objective) for domain in DOMAINS for objective in ("return", "peps", "human")]
    return plans + [
        training for domain in DOMAINS for method in ROWS for training in _trainings(plan, domain, method, many)
    ]


def _trainings(plan: Plan, domain: str, method: str, many: bool) -> list[Training]:
    asked = {"num_queries": plan.base.num_queries * MANY} if many and methods.get(method).asks else {}
    return plan.trainings(domain, method, **asked)


def write(plan: Plan, folder: Path, many: bool = False) -> list[Path]:
    """table1.{md,csv,tex}, and improvement.csv: how probably a training of PEPS scores higher than one of a baseline.

    With `many`, table1_many and improvement_many.
    """
    groups = {method: [plan.records(_trainings(plan, domain, method, many)) for domain in DOMAINS] for method in ROWS}
    lines = []
    for place, domain in enumerate(DOMAINS):
        for method in ROWS:
            made = line([domain], method, [groups[method][place]], plan.seeds)
            if method in PAPER["return"]:
                made |= {f"{score}_paper": PAPER[score][method][place] for score in SCORES}
            if method in ways.PAPER:
                made["way"] = _as_in_the_paper(domain, method, groups[method][place])
            lines.append(made)
        lines += [_planner_line(plan, domain, objective) for objective in ("return", "peps", "human")]
    lines += [line(DOMAINS, method, groups[method], plan.seeds * len(DOMAINS)) for method in ROWS]
    better = improvements(groups, DOMAINS, BASELINES)
    names, shown = [*head(paper=True), "way"], [[*cells(made, paper=True), made.get("way", "")] for made in lines]
    text = [
        markdown(names, shown),
        _NOTE.format(
            episodes=plan.num_episodes,
            lam=plan.base.lam,
            answers=plan.base.num_queries * (MANY if many else 1),
        ),
        "Probability that a training of PEPS scores higher than one of the baseline, with its 95 % interval:\n",
        markdown(["domain", "baseline", *SCORES], [improvement_cells(one) for one in better]),
        "Share of the way from SAC's to the planner's explicability, and rank correlation of r̂ and ℓ_H + r_H over the map, means\n"
        "over seeds:\n",
        markdown(
            ["domain", "planner − SAC", "PEPS covers", "rank correlation"],
            [
                _covered(plan, domain, groups["peps"][place], groups["sac"][place])
                for place, domain in enumerate(DOMAINS)
            ],
        ),
    ]
    suffix = "_many" if many else ""
    contents = {
        f"table1{suffix}.md": "\n".join(text),
        f"table1{suffix}.csv": csv_bytes(lines),
        f"table1{suffix}.tex": latex(names, shown),
        f"improvement{suffix}.csv": csv_bytes(better),
    }
    return write_texts(folder, contents)


def _covered(plan: Plan, domain: str, ours: Sequence[Record], base: Sequence[Record]) -> list[str]:
    best = plan.record(plan.planned(domain, "peps")).mean("explicability")
    gap, share = way_covered(ours, base, best)
    agreement = mean([record.rank_correlation() for record in ours])
    return [domain, decimal(gap), percent(share), decimal(agreement, 2)]


def _as_in_the_paper(domain: str, method: str, records: Sequence[Record]) -> str:
    alike = sum(_way(domain, record) == ways.PAPER[method][domain] for record in records)
    return f"{alike} of {len(records)}"


def _way(domain: str, record: Record) -> str:
    """That of its first episode."""
    steps, arrived = int(record.mode["length"][0]), bool(record.mode["goal_reached"][0])
    return ways.way(domain, record.routes[0][: steps + 1], arrived)


def _planner_line(plan: Plan, domain: str, objective: str) -> Line:
    record = plan.record(plan.planned(domain, objective))
    means = {f"{score}_mean": record.mean(score) for score in SCORES}
    told = {"goal_rate": record.mean("goal_reached"), "way": _way(domain, record)}
    return {"domain": domain, "method": f"planner, {objective}"} | means | told
