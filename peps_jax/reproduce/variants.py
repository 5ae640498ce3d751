"""Trainings that differ from the plan's in a few settings, in every domain with few seeds: what is needed, and a table's lines."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from peps_jax.reproduce.plan import DOMAINS, FEW_SEEDS, Need, Plan
from peps_jax.reproduce.summary import Line, line

Variants = Mapping[str, tuple[str, dict[str, Any]]]  # by their names: method, and changes of the plan's settings


def needs_of(plan: Plan, variants: Variants) -> list[Need]:
    """Every variant in every domain."""
    return [
        training
        for method, changes in variants.values()
        for domain in DOMAINS
        for training in plan.trainings(domain, method, FEW_SEEDS, **changes)
    ]


def lines_of(plan: Plan, variants: Variants) -> list[Line]:
    """A line for each variant in each domain, and over all."""
    lines, few = [], min(FEW_SEEDS, plan.seeds)
    for domains in (*([domain] for domain in DOMAINS), DOMAINS):
        for name, (method, changes) in variants.items():
            groups = [plan.records(plan.trainings(domain, method, FEW_SEEDS, **changes)) for domain in domains]
            lines.append(line(domains, name, groups, few * len(domains)))
    return lines
