"""Figure 1: the learned surrogate reward beside the true one, as heat maps over the domains."""

from __future__ import annotations

from pathlib import Path

import numpy as np

import peps_envs
from peps_jax.drawing.navigation_map import draw_heat
from peps_jax.drawing.panels import INK, panels_of
from peps_jax.reproduce.plan import DOMAINS, Need, Plan
from peps_jax.reproduce.summary import Line, explicability, title, write_picture

ABOUT = "the learned surrogate reward beside the true one"


def needs(plan: Plan) -> list[Need]:
    """PEPS in all domains."""
    return [training for domain in DOMAINS for training in plan.trainings(domain, "peps")]


def write(plan: Plan, folder: Path) -> list[Path]:
    """What PEPS learned as r-hat, above the true l_H + r_H: of the seed whose explicability is nearest to the median."""
    figure, panels = panels_of(2, len(DOMAINS), 3.0, 2.6)
    lines = []
    for column, domain in enumerate(DOMAINS):
        training = plan.typical(plan.trainings(domain, "peps"), explicability)
        if training is None:
            for axes in panels[:, column]:
                axes.set_axis_off()
            continue
        params = peps_envs.make(domain).params
        record = plan.record(training)
        heat, free = record.heat, record.heat["free"]
        for axes, name in zip(panels[:, column], ("learned", "true"), strict=True):
            draw_heat(figure, axes, np.where(free, heat[name], np.nan), params)
        panels[0, column].set_title(title(domain), color=INK, fontsize=11)
        panels[0, column].set_xlabel(f"rank correlation {record.rank_correlation():.2f}", color=INK, fontsize=8)
        lines += _heat_lines(domain, training.config.seed, heat, np.asarray(params.size))
    for axes, text in zip(panels[:, 0], ("learned r̂", "true ℓ_H + r_H"), strict=True):
        axes.set_ylabel(text, color=INK, fontsize=10)
    return write_picture(figure, lines, folder, "figure1")


def _heat_lines(domain: str, seed: int, heat: dict[str, np.ndarray], size: np.ndarray) -> list[Line]:
    rows, columns = heat["free"].shape
    lines = []
    for row, column in np.argwhere(heat["free"]):
        place = (np.array([column, row]) + 0.5) / (columns, rows) * size
        values = {name: round(float(heat[name][row, column]), 4) for name in ("learned", "true")}
        x, y = (round(float(value), 4) for value in place)
        lines.append({"domain": domain, "seed": seed, "x": x, "y": y} | values)
    return lines
