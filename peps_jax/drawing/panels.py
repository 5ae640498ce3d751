"""What every figure shares: colours, panels, quiet axes, and how it is saved. matplotlib is imported on the first one drawn."""

from __future__ import annotations

import colorsys
import io
import itertools
import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from peps_envs.pictures import ROLES as ROLES
from peps_jax import methods
from peps_jax.storage import files

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

INK, QUIET = ROLES["ink"], ROLES["quiet"]
# of methods, in the order they are registered
COLOURS = ("#c2255c", "#1c6dd0", "#e8890c", "#2f9e78", "#7048b6", "#5c6770")
DOTS = 200  # per inch


def panels_of(rows: int, columns: int, width: float, height: float | Sequence[float]) -> tuple[Figure, np.ndarray]:
    """A figure of panels `width` x `height` inches, or with a height for each row.

    Without pyplot: no display is asked for, and nothing is global.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    heights = np.broadcast_to(height, rows)
    figure = Figure(figsize=(columns * width, float(heights.sum())), layout="constrained", facecolor="white")
    FigureCanvasAgg(figure)
    return figure, figure.subplots(rows, columns, squeeze=False, height_ratios=heights)


def tidy(axes: Axes) -> None:
    """No box, quiet ticks, a faint grid behind."""
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color(QUIET)
    axes.tick_params(colors=QUIET, labelcolor=INK, labelsize=8)
    axes.grid(color="#ececec", linewidth=0.8)
    axes.set_axisbelow(True)


def bound(axes: Axes, name: str, level: float, colour: str) -> None:
    """A dashed line at what something else reaches."""
    axes.axhline(level, color=colour, linewidth=0.9, linestyle=(0, (4, 3)), label=name)


def legend_below(figure: Figure, axes: Axes) -> None:
    """What `axes` shows, as one row under all panels."""
    row_below(figure, axes.get_legend_handles_labels()[0])


def row_below(figure: Figure, handles: Sequence[Any], **style: Any) -> None:
    """A legend of `handles`, as one row under all panels."""
    style = {"fontsize": 8} | style
    figure.legend(handles=handles, frameon=False, loc="outside lower center", ncols=len(handles), **style)


def colour_of(method: str) -> str:
    """A method's colour, the same in every figure."""
    return colours(list(methods.METHODS).index(method) + 1)[-1]


def colours(number: int) -> list[str]:
    """So many different colours; the first ones are the same for every number."""
    found = list(COLOURS[:number])
    for place in itertools.count():
        if len(found) == number:
            return found
        hue = place * (5**0.5 - 1) / 2 % 1  # the golden ratio's multiples never come back to where one was
        parts = colorsys.hls_to_rgb(hue, (0.3, 0.45, 0.65)[place % 3], 0.75)
        code = "#" + "".join(f"{round(255 * part):02x}" for part in parts)
        if (
            min(_distance(code, other) for other in found) > 0.35 * 0.98**place
        ):  # the more there are, the nearer they lie
            found.append(code)


def _distance(code: str, other: str) -> float:
    """Euclidean distance of two colours "#rrggbb", each part from 0 to 1."""
    return math.dist(*([int(text[place : place + 2], 16) / 255 for place in (1, 3, 5)] for text in (code, other)))


def save(figure: Figure, folder: Path, name: str, kinds: Sequence[str] = ("png",)) -> list[Path]:
    """Writes name.kind for each of `kinds`; the same numbers make the same file. Raises NotWrittenError."""
    written = []
    for kind in kinds:
        buffer = io.BytesIO()
        undated = {"CreationDate": None} if kind == "pdf" else None
        figure.savefig(buffer, format=kind, dpi=DOTS, metadata=undated)
        files.write_whole(folder / f"{name}.{kind}", buffer.getvalue())
        written.append(folder / f"{name}.{kind}")
    return written
