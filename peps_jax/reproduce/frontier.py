"""The frontier: explicability against return, as lambda trades one for the other."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from peps_jax.analysis.surrogate_maps import rank_correlation
from peps_jax.drawing.panels import INK, QUIET, colour_of, panels_of, tidy
from peps_jax.reproduce.plan import BASELINES, DOMAINS, FEW_SEEDS, Need, Plan
from peps_jax.reproduce.summary import SCORES, TITLES, Line, decimal, estimates, mean, title, write_picture, write_texts
from peps_jax.storage.tables import markdown

if TYPE_CHECKING:
    from matplotlib.axes import Axes

ABOUT = "return and explicability over lambda"
LAMS = (0.0, 0.5, 1.0, 4.0)  # at which PEPS is trained, beside the plan's
PLANNED_LAMS = (0.0, 0.25, 0.5, 1.0, 2.0, 4.0, 8.0)  # of the planner's curve, beside the plan's
_INFLATION = """\
Deceptive inflation: what the human believes PEPS's policy to return (r_H, where the belief is what happens), minus what it
returns; means over seeds. Below 0 the human thinks less of the agent than it is worth.
"""


def _lams(plan: Plan, others: Sequence[float]) -> list[float]:
    return sorted({*others, float(plan.base.lam)})


def needs(plan: Plan) -> list[Need]:
    """PEPS over lambda and the baselines, with few seeds, and the planner over lambda."""
    plans = [plan.planned(domain, "peps", lam) for domain in DOMAINS for lam in _lams(plan, PLANNED_LAMS)]
    peps = [
        training
        for domain in DOMAINS
        for lam in _lams(plan, LAMS)
        for training in plan.trainings(domain, "peps", FEW_SEEDS, lam=lam)
    ]
    others = [
        training for domain in DOMAINS for method in BASELINES for training in plan.trainings(domain, method, FEW_SEEDS)
    ]
    return plans + peps + others


def write(plan: Plan, folder: Path) -> list[Path]:
    """frontier.{md,csv,png,pdf}: the planner's exact curve, PEPS over lambda, and the baselines."""
    figure, panels = panels_of(1, len(DOMAINS), 3.3, 3.1)
    lines = []
    for axes, domain in zip(panels[0], DOMAINS, strict=True):
        own = [_plan_point(plan, domain, lam) for lam in _lams(plan, PLANNED_LAMS)]
        own += [_point(plan, domain, "peps", lam) for lam in _lams(plan, LAMS)]
        own += [_point(plan, domain, method, None) for method in BASELINES]
        own = [point for point in own if np.isfinite(point["return"])]
        _draw(axes, own)
        axes.set_title(title(domain), color=INK, fontsize=11)
        axes.set_xlabel("return", color=INK, fontsize=9)
        lines += own
    panels[0, 0].set_ylabel("explicability", color=INK, fontsize=9)
    handles = {
        text: handle for axes in panels[0] for handle, text in zip(*axes.get_legend_handles_labels(), strict=True)
    }
    figure.legend(handles.values(), handles.keys(), frameon=False, fontsize=8, loc="outside lower center", ncols=5)
    return [*write_picture(figure, lines, folder, "frontier"), *write_texts(folder, {"frontier.md": _table(lines)})]


def _table(lines: Sequence[Line]) -> str:
    """Explicability over lambda, the planner's and PEPS's, and how well it rises with lambda: Spearman's correlation."""
    lams = sorted({line["lam"] for line in lines if line["method"] == "peps"})
    rows = []
    for domain in DOMAINS:
        for method in ("planner", "peps"):
            values = {line["lam"]: line["explicability"] for line in lines
                      if (line["domain"], line["method"]) == (domain, method)}  # fmt: skip
            at = [values.get(lam, np.nan) for lam in lams]
            rising = rank_correlation(np.array(lams), np.array(at)) if np.all(np.isfinite(at)) else np.nan
            rows.append([title(domain), TITLES.get(method, method), *map(decimal, at), decimal(rising, 2)])
    inflated = []
    for domain in DOMAINS:
        own = {line["lam"]: line["inflation"] for line in lines if (line["domain"], line["method"]) == (domain, "peps")}
        inflated.append([title(domain), *(decimal(own.get(lam)) for lam in lams)])
    return "\n".join([
        markdown(["domain", "explicability at λ", *(f"{lam:g}" for lam in lams), "Spearman"], rows),
        _INFLATION,
        markdown(["domain", *(f"λ = {lam:g}" for lam in lams)], inflated),
    ])  # fmt: skip


def _plan_point(plan: Plan, domain: str, lam: float) -> Line:
    record = plan.record(plan.planned(domain, "peps", lam))
    return {"domain": domain, "method": "planner", "lam": lam} | {score: record.mean(score) for score in SCORES}


def _point(plan: Plan, domain: str, method: str, lam: float | None) -> Line:
    """Interquartile means over the seeds, with their intervals."""
    changes = {} if lam is None else {"lam": lam}
    records = plan.records(plan.trainings(domain, method, FEW_SEEDS, **changes))
    made = {"domain": domain, "method": method, "lam": lam} | estimates(records)
    return made | {"believed_return": mean([record.mean("believed_return") for record in records]),
                   "inflation": mean([record.mean("believed_return") - record.mean("return") for record in records])}  # fmt: skip


def _draw(axes: Axes, points: Sequence[Line]) -> None:
    """Limits hold the planner's curve and PEPS; what is far below is named at the edge."""
    tidy(axes)
    inner = [point for point in points if point["method"] in ("planner", "sac")]
    limits = {}
    for score in SCORES:
        values = [point[score] for point in inner]
        room = 0.6 * (max(values) - min(values)) + 2.0
        limits[score] = (min(values) - room, max(values) + 0.4 * room)
    axes.set(xlim=limits["return"], ylim=limits["explicability"])
    seen = lambda point: all(low <= point[score] <= high for score, (low, high) in limits.items())
    curve = sorted((point for point in points if point["method"] == "planner"), key=lambda point: point["lam"])
    places = np.array([[point[score] for score in SCORES] for point in curve])
    axes.plot(*places.T, color=QUIET, linewidth=1.2, marker="D", markersize=3.5, label="planner over λ", zorder=2)
    hidden = []
    for method in ("peps", *BASELINES):
        own = [point for point in points if point["method"] == method]
        visible = [point for point in own if seen(point)]
        hidden += [point for point in own if not seen(point)]
        label = TITLES[method] + (", and its λ" if method == "peps" else "")
        for point in visible:
            spread = [
                [[point[score] - point[f"{score}_low"]], [point[f"{score}_high"] - point[score]]] for score in SCORES
            ]
            axes.errorbar(
                point["return"], point["explicability"], xerr=spread[0], yerr=spread[1], color=colour_of(method),
                marker="o", markersize=6, markeredgecolor="white", elinewidth=0.8, linewidth=0, label=label, zorder=3,
            )  # fmt: skip
            label = None
        if method == "peps":
            places = np.array([[point[score] for score in SCORES] for point in visible]).reshape(-1, 2)
            axes.plot(*places.T, color=colour_of(method), linewidth=1.0, alpha=0.6, zorder=2)
            low, high = np.array(list(limits.values())).T
            _note(axes, [f"{point['lam']:g}" for point in visible], (places - low) / (high - low))
    for number, point in enumerate(hidden):
        lam = f" λ = {point['lam']:g}" if point["lam"] is not None else ""
        text = f"↙ {TITLES[point['method']]}{lam} ({point['return']:.0f}, {point['explicability']:.0f})"
        colour = colour_of(point["method"])
        axes.text(0.03, 0.03 + 0.07 * number, text, transform=axes.transAxes, fontsize=7, color=colour)


def _at_one_place(places: np.ndarray) -> list[list[int]]:
    """Rows of `places` (n, 2), in shares of the axes, that can't be told apart: each with the first one that it is near to."""
    groups: list[list[int]] = []
    for number, place in enumerate(places):
        near = [group for group in groups if np.abs(place - places[group[0]]).max() < 0.06]
        if near:
            near[0].append(number)
        else:
            groups.append([number])
    return groups


def _note(axes: Axes, texts: Sequence[str], places: np.ndarray) -> None:
    """Texts beside their places (n, 2), in shares of the axes: where fewest places and texts before lie under them."""
    taken = [(place, place) for place in places]
    for together in _at_one_place(places):
        text, place = ", ".join(texts[number] for number in together), places[together[0]]
        sides = [(right, above) for above in (True, False) for right in (True, False)]
        crowd = [sum(_overlap(_box(place, text, *side), other) for other in taken) for side in sides]
        right, above = sides[int(np.argmin(crowd))]
        taken.append(_box(place, text, right, above))
        axes.annotate(
            text, place, (5 if right else -5, 5 if above else -5), xycoords="axes fraction", textcoords="offset points",
            fontsize=7, color=INK, ha="left" if right else "right", va="bottom" if above else "top",
        )  # fmt: skip


def _box(at: np.ndarray, text: str, right: bool, above: bool) -> tuple[np.ndarray, np.ndarray]:
    """Low and high corner of a text beside the place `at`, in shares of the axes."""
    size = np.array([0.02 * len(text), 0.05])
    low = at + np.where([right, above], 0.02, -0.02 - size)
    return low, low + size


def _overlap(box: tuple[np.ndarray, np.ndarray], other: tuple[np.ndarray, np.ndarray]) -> bool:
    return bool(np.all((box[0] <= other[1]) & (other[0] <= box[1])))
