"""Figure 2: the ways that every method takes through the domains."""

from __future__ import annotations

from pathlib import Path

import numpy as np

import peps_envs
from peps_jax.drawing.navigation_map import draw_map, draw_route, draw_start, key_below
from peps_jax.drawing.panels import INK, panels_of
from peps_jax.reproduce.plan import DOMAINS, METHODS, Need, Plan
from peps_jax.reproduce.summary import TITLES, explicability, title, write_picture

ABOUT = "rollouts of every method"


def needs(plan: Plan) -> list[Need]:
    """All methods in all domains."""
    return [training for domain in DOMAINS for method in METHODS for training in plan.trainings(domain, method)]


def write(plan: Plan, folder: Path) -> list[Path]:
    """Rollouts, a column for each method: one of every seed, and boldly the seed whose explicability is nearest to the median."""
    figure, panels = panels_of(len(DOMAINS), len(METHODS), 2.1, 2.1)
    lines = []
    for row, domain in enumerate(DOMAINS):
        params = peps_envs.make(domain).params
        for axes, method in zip(panels[row], METHODS, strict=True):
            draw_map(axes, params)
            trainings = plan.trainings(domain, method)
            typical = plan.typical(trainings, explicability)
            for training in sorted(trainings, key=lambda training: training is typical):  # the bold one last, on top
                record = plan.record(training)
                if record.failed:
                    continue
                route = record.routes[0][: int(record.mode["length"][0]) + 1]
                bold = training == typical
                draw_route(axes, route, method, alpha=1.0 if bold else 0.3, width=1.5 if bold else 0.8)
                told = {"domain": domain, "method": method, "seed": training.config.seed, "typical": bold}
                lines += [
                    told | {"step": step, "x": x, "y": y} for step, (x, y) in enumerate(np.round(route, 4).tolist())
                ]
            draw_start(axes, params)
            if row == 0:
                axes.set_title(TITLES[method], color=INK, fontsize=11)
        panels[row, 0].set_ylabel(title(domain), color=INK, fontsize=11)
    key_below(figure, [peps_envs.make(domain).params for domain in DOMAINS])
    return write_picture(figure, lines, folder, "figure2")
