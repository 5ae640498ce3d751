"""Table 1 at ten times as many answers: as many as the paper's program gives, and more than people do."""

from __future__ import annotations

from pathlib import Path

from peps_jax.reproduce import table1
from peps_jax.reproduce.plan import Need, Plan

ABOUT = f"the same at {table1.MANY} times as many answers"


def needs(plan: Plan) -> list[Need]:
    """As `table1.needs`."""
    return table1.needs(plan, many=True)


def write(plan: Plan, folder: Path) -> list[Path]:
    """table1_many.{md,csv,tex} and improvement_many.csv."""
    return table1.write(plan, folder, many=True)
