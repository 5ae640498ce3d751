"""Trainings that differ from the plan's in a few settings, in every domain: what is needed, and a table's lines."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from peps_jax.reproduce.plan import DOMAINS, FEW_SEEDS, Need, Plan
from peps_jax.reproduce.summary import Line, line

Variants = Mapping[str, tuple[str, dict[str, Any]]]  # by their names: method, and changes of the plan's settings


def needs_of(plan: Plan, variants: Variants, seeds: int | None = FEW_SEEDS) -> list[Need]:
    """Every variant in every domain, with the first `seeds` seeds; with all if it is None."""
    return [
        training
        for method, changes in variants.values()
        for domain in DOMAINS
        for training in plan.trainings(domain, method, seeds, **changes)
    ]


def lines_of(plan: Plan, variants: Variants, seeds: int | None = FEW_SEEDS) -> list[Line]:
    """A line for each variant in each domain, and over all, with the seeds of `needs_of`."""
    lines = []
    for domains in (*([domain] for domain in DOMAINS), DOMAINS):
        for name, (method, changes) in variants.items():
            trainings = [plan.trainings(domain, method, seeds, **changes) for domain in domains]
            lines.append(line(domains, name, [plan.records(each) for each in trainings], sum(map(len, trainings))))
    return lines
