"""The ablations: what Eq. (6) or the surrogate reward's fit is worth without parts of it."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

from peps_jax.config import Config
from peps_jax.reproduce.plan import Need, Plan
from peps_jax.reproduce.summary import write_table
from peps_jax.reproduce.variants import lines_of, needs_of

ABOUT = "PEPS and DRLHP without parts of them"


def variants(base: Config) -> dict[str, tuple[str, dict[str, Any]]]:
    """Methods, and what Eq. (6) or the surrogate reward's fit are left without, or get instead."""
    return {
        "PEPS": ("peps", {}),
        "without environment entropy": ("peps", {"environment_entropy_weight": 0.0}),
        "without policy entropy": ("peps", {"policy_entropy_weight": 0.0}),
        "policy entropy whole to the end": ("peps", {"entropy_fade_share": 0.0}),
        "absolute entropies": ("peps", {"entropies": "absolute"}),
        "r̂'s 0.95 quantile at 0": ("peps", {"level": "quantile"}),
        "r̂'s maximum at 0": ("peps", {"level": "max"}),
        "r̂'s mean at 0, deviation 1": ("peps", {"level": "standard"}),
        "r̂'s level free: equal lengths": ("peps", {"min_segment_length": base.segment_length}),
        "r̂ from nothing": ("peps", {"prior": "none"}),
        "r̂ without a bound": ("peps", {"bound": math.inf}),
        "critics not normalised": ("peps", {"critic_normalisation": False}),
        "single network": ("peps", {"ensemble_size": 1}),
        "DRLHP": ("drlhp", {}),
        "DRLHP, normalised by its authors' way": ("drlhp", {"level": "standard"}),
    }


def needs(plan: Plan) -> list[Need]:
    """Every variant in every domain, with few seeds."""
    return needs_of(plan, variants(plan.base))


def write(plan: Plan, folder: Path) -> list[Path]:
    """ablations.{md,csv,tex}."""
    return write_table(lines_of(plan, variants(plan.base)), folder, "ablations")
