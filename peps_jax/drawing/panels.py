"""What every figure shares: colours, panels, quiet axes, and how it is saved. matplotlib is imported on the first one drawn."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from peps_jax import methods
from peps_jax.storage import files

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

INK, QUIET = "#2b2b2b", "#8a8a8a"
COLOURS = (
    "#c2255c",
    "#1c6dd0",
    "#e8890c",
    "#2f9e78",
    "#7048b6",
    "#5c6770",
)  # of methods, in the order they are registered
DOTS = 200  # per inch


def panels_of(rows: int, columns: int, width: float, height: float) -> tuple[Figure, np.ndarray]:
    """A figure of panels `width` x `height` inches. Without pyplot: no display is asked for, and nothing is global."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(columns * width, rows * height), layout="constrained", facecolor="white")
    FigureCanvasAgg(figure)
    return figure, figure.subplots(rows, columns, squeeze=False)


def tidy(axes: Axes) -> None:
    """No box, quiet ticks, a faint grid behind."""
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color(QUIET)
    axes.tick_params(colors=QUIET, labelcolor=INK, labelsize=8)
    axes.grid(color="#ececec", linewidth=0.8)
    axes.set_axisbelow(True)


def colour_of(method: str) -> str:
    """A method's colour, the same in every figure."""
    return COLOURS[list(methods.METHODS).index(method) % len(COLOURS)]


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
