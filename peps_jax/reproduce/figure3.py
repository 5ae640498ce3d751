"""Figure 3: behaviours, crashes and ratings in the driving study."""

from __future__ import annotations

from pathlib import Path

from peps_jax.config import Config
from peps_jax.reproduce.driving import experiment, report
from peps_jax.reproduce.driving.experiment import Part
from peps_jax.reproduce.plan import Need, Plan

ABOUT = "behaviours and ratings in the driving study"


def needs(plan: Plan) -> list[Need]:
    """The agents of every method, and PEPS's over lambda; none of the trainings that tables and other figures share."""
    return list(_parts(plan))


def write(plan: Plan, folder: Path) -> list[Path]:
    """figure3.{md,json,png,gif}."""
    parts = _parts(plan)
    return report.write(experiment.findings(parts, list(map(plan.record, parts))), folder)


def _parts(plan: Plan) -> list[Part]:
    own = plan.base.total_steps == Config().total_steps  # a length that was asked for is the driving study's too
    return experiment.parts(range(plan.seeds), experiment.STEPS if own else plan.base.total_steps)
