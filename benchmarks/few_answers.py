"""What could make 100 answers enough: PEPS with one thing changed at a time; writes results/few_answers.md.

    python benchmarks/few_answers.py [--seeds 20]

The aim is most of the way from SAC's explicability to the planner's. Seeds are from 100 on: settings are chosen by what is seen
here, and tables and figures show others.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
import readme

from peps_jax import Config
from peps_jax.analysis.intervals import interquartile_mean
from peps_jax.command_line import use_every_core
from peps_jax.config import Lengths
from peps_jax.execution import batches
from peps_jax.execution.program import FinishedRun, Times
from peps_jax.execution.progress import Display
from peps_jax.reproduce.queries import QUERY_DOMAINS, REACHED, to_reach
from peps_jax.reproduce.summary import title
from peps_jax.storage import files
from peps_jax.storage.tables import markdown

OUT = Path(__file__).parent / "results" / "few_answers.md"
ANSWERS, MORE = 100, Config().num_queries
EPISODES, FIRST_SEED = 100, 100
DEFAULTS = "the defaults"


def changes() -> dict[str, dict[str, Any]]:
    """Settings beside the defaults, by what they are called."""
    base = Config()
    soon = Lengths(base.num_rounds, base.warmup_rounds, 0, ANSWERS)
    late = {"unasked_steps": base.warmup_steps}
    return {
        DEFAULTS: {},
        "all asked in the first half": {"num_queries": 2 * ANSWERS, "lengths": soon},
        "none asked while actions are random": late,
        "ten members": {"ensemble_size": 10},
        "ten members, none asked while actions are random": late | {"ensemble_size": 10},
        "50 candidate pairs for a query": {"candidates_per_query": 50},
        "queries by disagreement": {"query_strategy": "disagreement"},
        "segments of up to 8 steps": {"segment_length": 8},
        "twice as many steps on r̂": {"surrogate_updates": 2 * base.surrogate_updates},
        "weight decay 0.01": {"surrogate_decay": 1e-2},
        "λ = 1.2": {"lam": 1.2},
        f"{MORE} answers": {"num_queries": MORE},
        f"{MORE} answers, none asked while actions are random": late | {"num_queries": MORE},
        "the oracle, which asks nothing": {"method": "oracle"},
    }


def targets() -> dict[str, float]:
    """The explicability to reach in each domain, from Table 1 as it is published."""
    rows = readme.published("benchmarks/results/table1.csv")
    sac = lambda domain: float(rows[domain, "sac"]["explicability"])
    planner = lambda domain: float(
        rows[domain, readme.BEST]["explicability_mean"]
    )  # a plan is no sample, and has no IQM
    return {domain: to_reach(sac(domain), planner(domain)) for domain in QUERY_DOMAINS}


_NOTE = f"""\
{ANSWERS} answers where no other number is given, {{seeds}} seeds from {FIRST_SEED} on, {EPISODES} episodes each.
Explicability: interquartile means over seeds, and how many seeds reach what the head says, {REACHED:.0%} of the way from SAC's
explicability to the planner's. More: than the defaults with the same seeds, mean over domains and seeds and its standard error.
"""


class Scores(NamedTuple):
    """Of the trainings of one change, (trainings,) each."""

    explicability: np.ndarray
    arrived: np.ndarray  # bool, whether the mode does


def scores(changed: Mapping[str, Any], seeds: int) -> Scores:
    """Of every domain's seeds, one domain after the other."""
    config = Config(**({"num_queries": ANSWERS} | changed))
    over_seeds = range(FIRST_SEED, FIRST_SEED + seeds)
    configs = [config.replace(env=domain, seed=seed) for domain in QUERY_DOMAINS for seed in over_seeds]
    found = Scores(np.zeros(len(configs)), np.zeros(len(configs), bool))

    def keep(batch: batches.Batch, runs: Sequence[FinishedRun], times: Times) -> None:
        for place, run in zip(batch.runs, runs, strict=True):
            found.explicability[place] = np.mean(run.evaluation.explicability)
            found.arrived[place] = np.mean(run.evaluation.goal_reached) > 0.5

    divided = batches.plan(configs, EPISODES, most=batches.runs_soon_done(jax.devices()))
    with Display(configs, divided, keep) as display:
        batches.run(configs, divided, EPISODES, display)
    return found


def row(name: str, found: Scores, before: Scores, target: Mapping[str, float]) -> list[str]:
    """A line of the table."""
    by_domain = found.explicability.reshape(len(target), -1)
    levels = interquartile_mean(by_domain[..., None])
    reached = np.sum(by_domain >= np.array(list(target.values()))[:, None], 1)
    cells = [f"{level:.2f}, {number}" for level, number in zip(levels, reached, strict=True)]
    difference = found.explicability - before.explicability
    error = np.std(difference, ddof=1) / np.sqrt(difference.size)
    more = "" if name == DEFAULTS else f"{np.mean(difference):+.2f} ± {error:.2f}"
    return [name, *cells, more, f"{np.sum(found.arrived)} of {found.arrived.size}"]


def table(rows: Iterable[list[str]], target: Mapping[str, float], seeds: int) -> str:
    """As the documents show it."""
    head = ["PEPS with", *(f"{title(domain)}, of {level:.2f}" for domain, level in target.items()), "more", "arrive"]
    return f"{markdown(head, list(rows))}\n{_NOTE.format(seeds=seeds)}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--seeds", type=int, default=20, help="of each domain (default: %(default)s)")
    seeds = parser.parse_args().seeds
    if seeds < 2:
        parser.error(f"seeds {seeds} have no spread: choose 2 or more")
    use_every_core()
    target, rows, before = targets(), [], None
    for name, changed in changes().items():
        found = scores(changed, seeds)
        before = before or found
        rows.append(row(name, found, before, target))
        print(*rows[-1], sep=" | ", flush=True)
    files.write_whole(OUT, table(rows, target, seeds).encode())


if __name__ == "__main__":
    main()
