"""Other teachers than the one of Eq. (2): who errs, is myopic, can't tell, skips, is more or less sure, or knows better."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from peps_jax.reproduce.plan import FEW_SEEDS, Need, Plan
from peps_jax.reproduce.summary import cells, head, write_texts
from peps_jax.reproduce.variants import lines_of, needs_of
from peps_jax.storage.tables import csv_bytes, markdown

ABOUT = "PEPS by teachers who err, are myopic, can't tell, skip, or believe different things"
TEACHERS: dict[str, dict[str, Any]] = {
    "Eq. (2)": {},
    "errs in 10 %": {"mistake_rate": 0.1},
    "errs in 20 %": {"mistake_rate": 0.2},
    "errs in 20 %, and r̂ expects it": {"mistake_rate": 0.2, "uniform_answers": 0.4},
    "myopic: weighs a step by 0.7 of the next": {"myopia": 0.7},
    "calls it a tie within 2": {"indifference": 2.0},
    "skips if both are worth less than -8": {"skip_below": -8.0},
    "less sure: a third of the difference": {"rationality": 1 / 3},
    "surer: three times the difference": {"rationality": 3.0},
    "a quarter of the answers by who knows the truth": {"informed": 0.25},
    "half of the answers by who knows the truth": {"informed": 0.5},
}
VARIANTS = {name: ("peps", changes) for name, changes in TEACHERS.items()}
_NOTE = """\
PEPS, the plan's number of queries, interquartile means over up to {seeds} seeds. A query that is skipped isn't asked again.
"""


def needs(plan: Plan) -> list[Need]:
    """PEPS by every teacher, with few seeds."""
    return needs_of(plan, VARIANTS)


def write(plan: Plan, folder: Path) -> list[Path]:
    """teachers.{md,csv}."""
    lines = lines_of(plan, VARIANTS)
    names = ["teacher" if name == "method" else name for name in head(paper=False)]
    table = markdown(names, [cells(made, paper=False) for made in lines])
    return write_texts(
        folder, {"teachers.md": f"{table}\n{_NOTE.format(seeds=FEW_SEEDS)}", "teachers.csv": csv_bytes(lines)}
    )
