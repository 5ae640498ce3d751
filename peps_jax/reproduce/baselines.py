"""Further baselines beside Table 1's: another way to multiply policies, and who may step what the human believes in."""

from __future__ import annotations

from pathlib import Path

from peps_jax.config import Config
from peps_jax.reproduce.plan import Need, Plan
from peps_jax.reproduce.summary import write_table
from peps_jax.reproduce.table1 import MANY
from peps_jax.reproduce.variants import Variants, lines_of, needs_of

ABOUT = "further baselines beside Table 1's: a product of Gaussians, DARC"
_NOTE = """\
{answers:,} answers where nothing else is said; columns as in Table 1, of which PEPS, policy shaping and the oracle are. DARC may
step the dynamics that the human believes in, and asks nothing.
"""


def variants(base: Config) -> Variants:
    """Rows of Table 1, and what goes beside them."""
    many = base.num_queries * MANY
    gaussians = {"product": "gaussians"}
    return {
        "PEPS": ("peps", {}),
        "policy shaping": ("policy_shaping", {}),
        "policy shaping, Gaussians": ("policy_shaping", gaussians),
        f"policy shaping, {many:,} answers": ("policy_shaping", {"num_queries": many}),
        f"policy shaping, Gaussians, {many:,} answers": ("policy_shaping", gaussians | {"num_queries": many}),
        "oracle": ("oracle", {}),
        "DARC": ("darc", {}),
    }


def needs(plan: Plan) -> list[Need]:
    """Every row in every domain, with all seeds."""
    return needs_of(plan, variants(plan.base), seeds=None)


def write(plan: Plan, folder: Path) -> list[Path]:
    """baselines.{md,csv,tex}."""
    lines = lines_of(plan, variants(plan.base), seeds=None)
    return write_table(lines, folder, "baselines", _NOTE.format(answers=plan.base.num_queries))
