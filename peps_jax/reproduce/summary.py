"""What the records of several trainings come to: estimates, a line of a table, and how both are written.

Scores are means over a training's episodes, with the policy's mode unless "sampled" is said. A line's estimate is the
interquartile mean over its seeds with a 95 % bootstrap interval; over all domains at once it is stratified, each domain
resampled by itself. A training that failed is left out, and its line says how many there were.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from peps_jax.analysis.intervals import Estimate, estimate, interquartile_mean, probability_of_improvement
from peps_jax.drawing.panels import save
from peps_jax.reproduce.store import Record
from peps_jax.storage import files
from peps_jax.storage.tables import csv_bytes, latex, markdown

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SCORES = ("return", "explicability")
TITLES = {
    "peps": "PEPS", "sac": "SAC", "drlhp": "DRLHP", "policy_shaping": "policy shaping", "oracle": "oracle", "darc": "DARC",
    "human_expectation": "human",
}  # fmt: skip

Line = dict[str, Any]  # a line of a CSV file


def title(domain: str) -> str:
    """A domain's name in a figure."""
    return domain.removeprefix("nav-").upper()


def explicability(record: Record) -> float:
    """Mean over episodes."""
    return record.mean("explicability")


def mean(values: Sequence[float] | np.ndarray) -> float:
    """nan where there is nothing."""
    return float(np.mean(values)) if len(values) else math.nan


def interval(*scores: Sequence[Sequence[float]], statistic: Any = interquartile_mean) -> Estimate:
    """`statistic` of scores (tasks, runs), which may be fewer in some tasks; nan without two runs in each."""
    fewest = [min(map(len, tasks), default=0) for tasks in scores]
    if min(fewest) < 2:
        return Estimate(math.nan, math.nan, math.nan)
    runs = [np.array([task[:few] for task in tasks]).T for tasks, few in zip(scores, fewest, strict=True)]
    return estimate(statistic, *runs)


def in_columns(score: str, found: Estimate) -> Line:
    """An estimate as a line has it: `score`, and the ends of its interval."""
    return {score: found.value, f"{score}_low": found.low, f"{score}_high": found.high}


def from_columns(made: Mapping[str, Any], score: str) -> Estimate:
    """What `in_columns` was given."""
    return Estimate(*(made[f"{score}{end}"] for end in ("", "_low", "_high")))


def estimates(records: Sequence[Record]) -> Line:
    """Interquartile means of both scores over the seeds, with their intervals."""
    made: Line = {"seeds": len(records)}
    for score in SCORES:
        made |= in_columns(score, interval([[record.mean(score) for record in records]]))
    return made


def line(domains: Sequence[str], what: str, groups: Sequence[Sequence[Record]], trained: int) -> Line:
    """The numbers of one method or variant, from its records in each of `domains`; `trained` of them there were."""
    good = [record for group in groups for record in group]
    made: Line = {"domain": domains[0] if len(domains) == 1 else "all", "method": what}
    made |= {"seeds": len(good) // len(domains), "failed": trained - len(good)}
    for score in SCORES:
        values = [[record.mean(score) for record in group] for group in groups]
        made |= in_columns(score, interval(values))
        pooled = np.concatenate(values)
        made |= {f"{score}_mean": mean(pooled), f"{score}_sd": float(np.std(pooled)) if pooled.size else math.nan}
    rates = [record.mean("goal_reached") for record in good]
    made |= {"arrived": sum(rate > 0.5 for rate in rates), "trained": trained, "goal_rate": mean(rates)}
    made |= {f"sampled_{score}": mean([record.mean(score, sampled=True) for record in good]) for score in SCORES}
    return made


def improvements(
    groups: Mapping[str, Sequence[Sequence[Record]]], domains: Sequence[str], baselines: Sequence[str]
) -> list[Line]:
    """How probably a training of PEPS scores higher than one of each baseline: in each of `domains`, and over all.

    `groups` are records by method, and of each method by domain.
    """
    lines = []
    for places, domain in (*(([place], domain) for place, domain in enumerate(domains)), (range(len(domains)), "all")):
        for baseline in baselines:
            made: Line = {"domain": domain, "baseline": baseline}
            for score in SCORES:
                ours, theirs = (
                    [[record.mean(score) for record in groups[method][place]] for place in places]
                    for method in ("peps", baseline)
                )
                made |= in_columns(score, interval(ours, theirs, statistic=probability_of_improvement))
            lines.append(made)
    return lines


def improvement_cells(made: Mapping[str, Any]) -> list[str]:
    """A line of `improvements` as a table shows it."""
    shown = [with_interval(from_columns(made, score), 2) for score in SCORES]
    return [made["domain"], TITLES[made["baseline"]], *shown]


def way_covered(ours: Sequence[Record], base: Sequence[Record], best: float) -> tuple[float, float]:
    """How far it is from `base` to `best` in explicability, and the share of it that `ours` covers; nan where there is no way."""
    reached, from_where = (mean([record.mean("explicability") for record in records]) for records in (ours, base))
    gap = best - from_where
    return gap, (reached - from_where) / gap if gap > 0 else math.nan


def percent(share: float) -> str:
    """A share in a table; a dash where there is none."""
    return f"{share:.0%}" if math.isfinite(share) else "–"


def decimal(value: float | None, digits: int = 1) -> str:
    """A number in a table; a dash where there is none."""
    return "–" if value is None or not math.isfinite(value) else f"{value:.{digits}f}"


def with_interval(found: Estimate, digits: int = 1) -> str:
    """A value and its interval."""
    if not math.isfinite(found.value):
        return "–"
    return f"{decimal(found.value, digits)} [{decimal(found.low, digits)}, {decimal(found.high, digits)}]"


def _estimate(made: Mapping[str, Any], score: str) -> str:
    if score not in made:  # of the planner, which has no seeds
        return decimal(made[f"{score}_mean"])
    return with_interval(from_columns(made, score))


def cells(made: Mapping[str, Any], paper: bool) -> list[str]:
    """A line as a table shows it."""
    shown = [made["domain"], TITLES.get(made["method"], made["method"]), _arrive(made)]
    for score in SCORES:
        spread = f"{decimal(made[f'{score}_mean'])} ± {decimal(made[f'{score}_sd'])}" if f"{score}_sd" in made else ""
        shown += [_estimate(made, score), spread] + [_paper(made, score)] * paper
    sampled = [made.get(f"sampled_{score}") for score in SCORES]
    return [*shown, "" if sampled[0] is None else " / ".join(map(decimal, sampled))]


def _arrive(made: Mapping[str, Any]) -> str:
    """How many seeds reach the goal by their mode, a training that failed among those that don't."""
    return f"{made['arrived']} of {made['trained']}" if "arrived" in made else decimal(made.get("goal_rate"), 2)


def _paper(made: Mapping[str, Any], score: str) -> str:
    value = made.get(f"{score}_paper")
    return "" if value is None else f"{value:.2f}"


def head(paper: bool) -> list[str]:
    """The names of `cells`."""
    names = ["domain", "method", "arrive"]
    for score in SCORES:
        names += [f"{score}, IQM [95 %]", "mean ± sd"] + ["paper"] * paper
    return [*names, "sampled: return / explicability"]


def write_texts(folder: Path, contents: Mapping[str, str | bytes]) -> list[Path]:
    """Writes files by their names; returns their paths."""
    for name, content in contents.items():
        files.write_whole(folder / name, content.encode() if isinstance(content, str) else content)
    return [folder / name for name in contents]


def write_table(lines: Sequence[Line], folder: Path, name: str, note: str = "") -> list[Path]:
    """Writes name.{md,csv,tex}: lines of `line`, and below them what there is to say about them."""
    names, shown = head(paper=False), [cells(made, paper=False) for made in lines]
    text = markdown(names, shown)
    contents = {
        f"{name}.md": f"{text}\n{note}" if note else text,
        f"{name}.csv": csv_bytes(lines),
        f"{name}.tex": latex(names, shown),
    }
    return write_texts(folder, contents)


def write_picture(picture: Figure, lines: Sequence[Line], folder: Path, name: str) -> list[Path]:
    """Writes name.{csv,png,pdf}: a picture, and the numbers behind it."""
    return [*write_texts(folder, {f"{name}.csv": csv_bytes(lines)}), *save(picture, folder, name, ("png", "pdf"))]
