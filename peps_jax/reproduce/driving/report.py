"""The study's files: what was found as tables and numbers, film strips, and a film."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

import peps_envs
from peps_jax.drawing import scenes as pictures
from peps_jax.preferences.data import Segments
from peps_jax.reproduce.driving.experiment import OWN, Conduct, Findings
from peps_jax.reproduce.driving.ratings import RATERS, Group
from peps_jax.reproduce.driving.scenes import BEHAVIOURS, HORIZON, RAIN, typical
from peps_jax.reproduce.summary import TITLES
from peps_jax.storage import files
from peps_jax.storage.tables import markdown

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MOMENTS = (1.0, 3.0, 5.0)  # s after the start, of the paper's Figure 3
RATE = 6  # pictures of the film for a second of the scene
OVER = {"lam": "λ", "each": "answers of each participant"}  # fields of a variant that have tables
PICTURE, FILM, NUMBERS, TABLE = "figure3.png", "figure3.gif", "figure3.json", "figure3.md"
# Gong and Zhang 2021, Figure 3: mean and standard deviation of 15 ratings; p = 0.037
PAPER = {"peps": (7.6, 2.4), "sac": (5.0, 2.3), "drlhp": (5.9, 2.2)}


def shares(groups: Sequence[Group]) -> dict[str, float]:
    """How many groups of raters rate PEPS highest, how many differ significantly, and both, from 0 to 1."""
    highest = np.array([max(group.mean, key=group.mean.get) == "peps" for group in groups])
    significant = np.array([group.p < 0.05 for group in groups])
    both = highest & significant
    return {"highest": float(highest.mean()), "significant": float(significant.mean()), "both": float(both.mean())}


def _rated(groups: Sequence[Group]) -> dict[str, Any]:
    return {"ratings": groups[0]._asdict(), "groups": len(groups), "groups_that": shares(groups)}


def _said(groups: Sequence[Group], paper: str = "") -> str:
    """What the raters' analysis says, in a line."""
    told, first = shares(groups), groups[0]
    return (
        f"one-way ANOVA of the ratings by {RATERS} raters: p = {first.p:.2g}, η² = {first.eta_squared:.2f}{paper}. "
        f"Of {len(groups)} groups of raters {told['highest']:.0%} rate PEPS highest, {told['significant']:.0%} differ with "
        f"p < 0.05, both in {told['both']:.0%}."
    )


def summary(findings: Findings) -> dict[str, Any]:
    """Everything found but the scenes, as JSON knows it."""
    return {
        "behaviours": BEHAVIOURS,
        "conduct": {method: found._asdict() for method, found in findings.conduct.items()},
        **{
            f"over_{name}": [{name: value} | found._asdict() for value, found in findings.over(name).items()]
            for name in OVER
        },
        **OWN._asdict(),
        **_rated(findings.groups),
        "wider": _rated(findings.wider) if findings.wider else None,
    }


def _behaves(found: Conduct) -> list[str]:
    """Cells of a table: seeds with each behaviour, crashes, return."""
    seeds = len(found.shares)
    counted = [f"{found.seeds_that(kind)} of {seeds}" for kind in range(len(BEHAVIOURS))]
    if not seeds:
        return [*counted, "–", "–"]
    failed = f" ({found.failed} failed)" * (found.failed > 0)
    return [*counted, f"{np.mean(found.crash_rate):.1%}", f"{np.mean(found.return_):.2f}{failed}"]


def text(findings: Findings) -> str:
    """What was found, in Markdown."""
    columns = {"rating": findings.groups, "rating with all shown": findings.wider}
    rated = {name: groups[0] for name, groups in columns.items() if groups}
    heads = [*BEHAVIOURS, "crashes", "return"]
    rating = lambda group, method: f"{group.mean[method]:.1f} ± {group.sd[method]:.1f}" if method in group.mean else ""
    rows = []
    for method, found in findings.conduct.items():
        paper = "{} ± {}".format(*PAPER[method]) if method in PAPER else ""
        rows.append([TITLES[method], *_behaves(found), *(rating(group, method) for group in rated.values()), paper])
    parts = [
        markdown(["agent", *heads, *rated, "paper's rating"], rows),
        f"Agents by what they do in most scenes. Of the paper's agents, {_said(findings.groups, ' (paper: p = 0.037)')}\n",
    ]
    if findings.wider:
        parts.append(f"With all shown, {_said(findings.wider)}\n")
    for name, title in OVER.items():
        found = findings.over(name)
        if len(found) > 1:
            rows = [[f"{value:g}", *_behaves(conduct)] for value, conduct in found.items()]
            own = getattr(OWN, name)
            parts += [f"PEPS over {title}, of which the study's is {own:g}:\n", markdown([title, *heads], rows)]
    return "\n".join(parts)


def clips(shown: Mapping[str, Any], times: Sequence[float]) -> dict[str, list[peps_envs.Scene]]:
    """What there is to see of each title's states (moments, ...) at `times` (s, a policy step each)."""
    task = peps_envs.make(RAIN)
    return {title: pictures.scenes_of(task.environment, task.params, states, times) for title, states in shown.items()}


def shown(scenes: Mapping[str, Segments], rated: Group) -> dict[str, Any]:
    """States of a typical scene of each method, by its title with what raters said of it."""
    title = lambda method: f"{TITLES[method]} (μ = {rated.mean[method]:.1f}, σ = {rated.sd[method]:.1f})"
    return {title(method): pictures.states_of(typical(found)) for method, found in scenes.items()}


def figure(states: Mapping[str, Any], note: str) -> Figure:
    """The paper's Figure 3: each title's scene at `MOMENTS`, and a note below."""
    return pictures.strips(clips(states, MOMENTS), [f"{time:g} s" for time in MOMENTS], note)


def write(findings: Findings, folder: Path) -> list[Path]:
    """Writes figure3.png, .gif, .json and .md; returns the paths."""
    rated = (findings.wider or findings.groups)[0]
    states = shown(findings.scenes, rated)
    files.make_folder(folder)
    strips = figure(states, f"ratings by simulated participants; one-way ANOVA: p = {rated.p:.2g}")
    files.write_with(folder / PICTURE, lambda path: strips.savefig(path, dpi=150))
    times = np.arange(0, HORIZON + 0.5, 1 / RATE)
    files.write_with(folder / FILM, lambda path: pictures.film(clips(states, times), path, RATE))
    numbers = json.dumps(summary(findings), indent=1, allow_nan=False) + "\n"
    files.write_whole(folder / NUMBERS, numbers.encode())
    files.write_whole(folder / TABLE, text(findings).encode())
    return [folder / name for name in (TABLE, PICTURE, FILM, NUMBERS)]
