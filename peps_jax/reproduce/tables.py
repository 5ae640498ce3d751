"""Table 1 and the ablations: Markdown, CSV and LaTeX from the same lines.

Scores are means over a training's episodes, with the policy's mode unless "sampled" is said. A line's estimate is the
interquartile mean over its seeds with a 95 % bootstrap interval; over all domains at once it is stratified, each domain
resampled by itself. A training that failed is left out, and its line says how many there were.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from peps_jax.analysis.intervals import Estimate, estimate, interquartile_mean, probability_of_improvement
from peps_jax.config import Config
from peps_jax.reproduce.driving import report
from peps_jax.reproduce.store import Record
from peps_jax.reproduce.trainings import BASELINES, DOMAINS, FEW_SEEDS, METHODS, Planned, Study, Training
from peps_jax.storage import files
from peps_jax.storage.tables import csv_bytes, markdown

SCORES = ("return", "explicability")
TITLES = report.TITLES | {"human_expectation": "human"}
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
IQM: interquartile mean over seeds, with a 95 % stratified bootstrap interval; {episodes} episodes a seed by the policy's mode,
"sampled" by its samples. Paper: Gong and Zhang 2021, Table 1. The planner knows dynamics, belief and rewards; "peps" is Eq. (6)
at λ = {lam:g}. "human" acts, and is scored, in the MDP that the human believes in.
"""

Line = dict[str, Any]  # a line of a CSV file


# --- numbers --------------------------------------------------------------------------------------------------------------


def interval(*scores: Sequence[Sequence[float]], statistic: Any = interquartile_mean) -> Estimate:
    """`statistic` of scores (tasks, runs), which may be fewer in some tasks; nan without two runs in each."""
    fewest = [min(map(len, tasks), default=0) for tasks in scores]
    if min(fewest) < 2:
        return Estimate(math.nan, math.nan, math.nan)
    runs = [np.array([task[:few] for task in tasks]).T for tasks, few in zip(scores, fewest, strict=True)]
    return estimate(statistic, *runs)


def line(domains: Sequence[str], what: str, groups: Sequence[Sequence[Record]], trained: int) -> Line:
    """The numbers of one method or variant, from its records in each of `domains`; `trained` of them there were."""
    good = [record for group in groups for record in group]
    made: Line = {"domain": domains[0] if len(domains) == 1 else "all", "method": what}
    made |= {"seeds": len(good) // len(domains), "failed": trained - len(good)}
    for score in SCORES:
        values = [[record.mean(score) for record in group] for group in groups]
        found = interval(values)
        made |= {score: found.value, f"{score}_low": found.low, f"{score}_high": found.high}
        pooled = np.concatenate(values)
        made |= {f"{score}_mean": _mean(pooled), f"{score}_sd": float(np.std(pooled)) if pooled.size else math.nan}
    made["goal_rate"] = _mean([record.mean("goal_reached") for record in good])
    made |= {f"sampled_{score}": _mean([record.mean(score, sampled=True) for record in good]) for score in SCORES}
    return made


def _mean(values: Any) -> float:
    return float(np.mean(values)) if len(values) else math.nan


def _planner_line(study: Study, domain: str, objective: str) -> Line:
    record = study.record(study.planned(domain, objective))
    means = {f"{score}_mean": record.mean(score) for score in SCORES}
    return {"domain": domain, "method": f"planner, {objective}"} | means | {"goal_rate": record.mean("goal_reached")}


# --- formats --------------------------------------------------------------------------------------------------------------


def figure(value: float | None, digits: int = 1) -> str:
    """A number in a table; a dash where there is none."""
    return "–" if value is None or not math.isfinite(value) else f"{value:.{digits}f}"


def with_interval(found: Estimate, digits: int = 1) -> str:
    """A value and its interval."""
    if not math.isfinite(found.value):
        return "–"
    return f"{figure(found.value, digits)} [{figure(found.low, digits)}, {figure(found.high, digits)}]"


def latex(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table in LaTeX, for the package booktabs; a rule wherever the first column changes."""
    shown = lambda cells: " & ".join(map(_escaped, cells)) + r" \\"
    lines = [rf"\begin{{tabular}}{{ll{'r' * (len(head) - 2)}}}", r"\toprule", shown(head), r"\midrule"]
    for place, row in enumerate(rows):
        if place and row[0] != rows[place - 1][0]:
            lines.append(r"\midrule")
        lines.append(shown(row))
    return "\n".join([*lines, r"\bottomrule", r"\end{tabular}"]) + "\n"


def _escaped(text: str) -> str:
    written = {"%": r"\%", "_": r"\_", "±": r"$\pm$", "–": "--", "r̂": r"$\hat r$", "λ": r"$\lambda$"}
    for sign, command in written.items():
        text = text.replace(sign, command)
    return text


def _estimate(made: Mapping[str, Any], score: str) -> str:
    if score not in made:  # of the planner, which has no seeds
        return figure(made[f"{score}_mean"])
    return with_interval(Estimate(made[score], made[f"{score}_low"], made[f"{score}_high"]))


def _cells(made: Mapping[str, Any], paper: bool) -> list[str]:
    """A line as a table shows it."""
    cells = [made["domain"], TITLES.get(made["method"], made["method"]), _seeds(made)]
    for score in SCORES:
        spread = f"{figure(made[f'{score}_mean'])} ± {figure(made[f'{score}_sd'])}" if f"{score}_sd" in made else ""
        cells += [_estimate(made, score), spread] + [_paper(made, score)] * paper
    cells.append(figure(made.get("goal_rate"), 2))
    sampled = [made.get(f"sampled_{score}") for score in SCORES]
    return [*cells, "" if sampled[0] is None else " / ".join(map(figure, sampled))]


def _seeds(made: Mapping[str, Any]) -> str:
    if "seeds" not in made:
        return ""
    return f"{made['seeds']}" + f" ({made['failed']} failed)" * (made["failed"] > 0)


def _paper(made: Mapping[str, Any], score: str) -> str:
    value = made.get(f"{score}_paper")
    return "" if value is None else f"{value:.2f}"


def _head(paper: bool) -> list[str]:
    head = ["domain", "method", "seeds"]
    for score in SCORES:
        head += [f"{score}, IQM [95 %]", "mean ± sd"] + ["paper"] * paper
    return [*head, "goal", "sampled: return / explicability"]


def _write(folder: Path, contents: Mapping[str, str | bytes]) -> list[Path]:
    for name, content in contents.items():
        files.write_whole(folder / name, content.encode() if isinstance(content, str) else content)
    return [folder / name for name in contents]


# --- Table 1 --------------------------------------------------------------------------------------------------------------


def table1_needs(study: Study) -> list[Training | Planned]:
    """All methods in all domains, and the planner's bounds."""
    plans = [study.planned(domain, objective) for domain in DOMAINS for objective in ("return", "peps", "human")]
    return plans + [cell for domain in DOMAINS for method in METHODS for cell in study.trainings(domain, method)]


def table1(study: Study, folder: Path) -> list[Path]:
    """table1.{md,csv,tex}, and improvement.csv: how probably a training of PEPS scores higher than one of a baseline."""
    groups = {method: [study.records(study.trainings(domain, method)) for domain in DOMAINS] for method in METHODS}
    lines = []
    for place, domain in enumerate(DOMAINS):
        for method in METHODS:
            made = line([domain], method, [groups[method][place]], study.seeds)
            if method in PAPER["return"]:
                made |= {f"{score}_paper": PAPER[score][method][place] for score in SCORES}
            lines.append(made)
        lines += [_planner_line(study, domain, objective) for objective in ("return", "peps", "human")]
    lines += [line(DOMAINS, method, groups[method], study.seeds * len(DOMAINS)) for method in METHODS]
    improvements = _improvements(groups)
    shown = [_cells(made, paper=True) for made in lines]
    text = [
        markdown(_head(paper=True), shown),
        _NOTE.format(episodes=study.num_episodes, lam=study.base.lam),
        "Probability that a training of PEPS scores higher than one of the baseline, with its 95 % interval:\n",
        markdown(["domain", "baseline", *SCORES], [_improvement_cells(one) for one in improvements]),
        "Share of the way from SAC's to the planner's explicability, mean over seeds:\n",
        markdown(["domain", "planner − SAC", "PEPS covers"], [_covered(study, domain) for domain in DOMAINS]),
    ]
    contents = {
        "table1.md": "\n".join(text),
        "table1.csv": csv_bytes(lines),
        "table1.tex": latex(_head(paper=True), shown),
        "improvement.csv": csv_bytes(improvements),
    }
    return _write(folder, contents)


def _improvements(groups: Mapping[str, Sequence[Sequence[Record]]]) -> list[Line]:
    """PEPS against each baseline, in each domain and over all."""
    lines = []
    for places, domain in (*(([place], domain) for place, domain in enumerate(DOMAINS)), (range(len(DOMAINS)), "all")):
        for baseline in BASELINES:
            made: Line = {"domain": domain, "baseline": baseline}
            for score in SCORES:
                ours, theirs = (
                    [[record.mean(score) for record in groups[method][place]] for place in places]
                    for method in ("peps", baseline)
                )
                found = interval(ours, theirs, statistic=probability_of_improvement)
                made |= {score: found.value, f"{score}_low": found.low, f"{score}_high": found.high}
            lines.append(made)
    return lines


def _improvement_cells(made: Mapping[str, Any]) -> list[str]:
    shown = [Estimate(made[score], made[f"{score}_low"], made[f"{score}_high"]) for score in SCORES]
    return [made["domain"], TITLES[made["baseline"]], *(with_interval(found, 2) for found in shown)]


def _covered(study: Study, domain: str) -> list[str]:
    best = study.record(study.planned(domain, "peps")).mean("explicability")
    ours, base = (
        _mean([record.mean("explicability") for record in study.records(study.trainings(domain, method))])
        for method in ("peps", "sac")
    )
    gap = best - base
    share = (ours - base) / gap if gap > 0 else math.nan
    return [domain, figure(gap), f"{share:.0%}" if math.isfinite(share) else "–"]


# --- ablations ------------------------------------------------------------------------------------------------------------


def variants(base: Config) -> dict[str, tuple[str, dict[str, Any]]]:
    """Methods, and what Eq. (6) or the surrogate reward's fit are left without, or get instead."""
    return {
        "PEPS": ("peps", {}),
        "without environment entropy": ("peps", {"environment_entropy_weight": 0.0}),
        "without policy entropy": ("peps", {"policy_entropy_weight": 0.0}),
        "absolute entropies": ("peps", {"entropies": "absolute"}),
        "r̂'s 0.95 quantile at 0": ("peps", {"level": "quantile"}),
        "r̂'s maximum at 0": ("peps", {"level": "max"}),
        "r̂'s mean at 0, deviation 1": ("peps", {"level": "standard"}),
        "r̂'s level free: equal lengths": ("peps", {"min_segment_length": base.segment_length}),
        "single network": ("peps", {"ensemble_size": 1}),
        "DRLHP": ("drlhp", {}),
        "DRLHP, normalised by its authors' way": ("drlhp", {"level": "standard"}),
    }


def ablations_needs(study: Study) -> list[Training | Planned]:
    """Every variant in every domain, with few seeds."""
    return [
        cell
        for method, changes in variants(study.base).values()
        for domain in DOMAINS
        for cell in study.trainings(domain, method, FEW_SEEDS, **changes)
    ]


def ablations(study: Study, folder: Path) -> list[Path]:
    """ablations.{md,csv,tex}."""
    lines, few = [], min(FEW_SEEDS, study.seeds)
    for domains in (*([domain] for domain in DOMAINS), DOMAINS):
        for name, (method, changes) in variants(study.base).items():
            cells = [study.trainings(domain, method, FEW_SEEDS, **changes) for domain in domains]
            lines.append(line(domains, name, list(map(study.records, cells)), few * len(domains)))
    shown = [_cells(made, paper=False) for made in lines]
    contents = {
        "ablations.md": markdown(_head(paper=False), shown),
        "ablations.csv": csv_bytes(lines),
        "ablations.tex": latex(_head(paper=False), shown),
    }
    return _write(folder, contents)
