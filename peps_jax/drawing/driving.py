"""Driving scenes as pictures: strips of three moments, as in the paper's Figure 3, and a film."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from peps_envs.highway.vehicle import LANE_WIDTH, LENGTH, WIDTH
from peps_jax.drawing.panels import INK, QUIET, panels_of
from peps_jax.trajectory import Segments

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

ROAD, EGO, OTHER, WRECK = "#d9d9d6", "#2f9e78", "#1c6dd0", "#c2255c"
MOMENTS = (1.0, 3.0, 5.0)  # s after the start
BEHIND, AHEAD = 20.0, 60.0  # m of the road in sight of the ego
FRAMES = 6  # pictures of the film for a second of the scene


class Moment(NamedTuple):
    """Where all cars are, (n,) each."""

    x: np.ndarray
    y: np.ndarray
    heading: np.ndarray
    crashed: np.ndarray


def moment(scene: Segments, time: float) -> Moment:
    """`scene` (horizon, ...) at `time` (s, one policy step each), between two steps by interpolation; as it ended after its end."""
    last = int(np.sum(scene.mask))
    time = min(time, last)
    before = min(int(time), last - 1)
    now = lambda vehicles, name: np.asarray(getattr(vehicles, name)[before], float)
    old, new = scene.state.vehicles, scene.next_state.vehicles
    share = time - before
    mix = lambda name: (1 - share) * now(old, name) + share * now(new, name)
    return Moment(mix("x"), mix("y"), mix("heading"), now(new if share == 1 else old, "crashed") > 0)


def draw(axes: Axes, cars: Moment, lanes: int = 2) -> None:
    """The road around the ego, which is green; the others are blue, and who has crashed is red."""
    from matplotlib.patches import Rectangle
    from matplotlib.transforms import Affine2D

    axes.clear()
    left, right = cars.x[0] - BEHIND, cars.x[0] + AHEAD
    axes.set(
        xlim=(left, right), ylim=((lanes - 0.4) * LANE_WIDTH, -0.6 * LANE_WIDTH), aspect="equal", xticks=[], yticks=[]
    )
    axes.set_facecolor(ROAD)
    for spine in axes.spines.values():
        spine.set_visible(False)
    for line in range(lanes + 1):
        edge = line in (0, lanes)
        style = dict(color=QUIET if edge else "white", linewidth=1.2, zorder=1)
        if edge:
            axes.plot((left, right), 2 * ((line - 0.5) * LANE_WIDTH,), **style)
            continue
        first = np.floor(left / 12) * 12  # dashes stay on the road while the picture moves with the ego
        for start in np.arange(first, right, 12):
            axes.plot((start, start + 5), 2 * ((line - 0.5) * LANE_WIDTH,), **style)
    for car in range(len(cars.x)):
        colour = WRECK if cars.crashed[car] else OTHER if car else EGO
        turn = Affine2D().rotate_around(cars.x[car], cars.y[car], cars.heading[car])
        place = (cars.x[car] - LENGTH / 2, cars.y[car] - WIDTH / 2)
        body = Rectangle(place, LENGTH, WIDTH, facecolor=colour, edgecolor=INK, linewidth=0.6, zorder=2)
        body.set_transform(turn + axes.transData)
        axes.add_patch(body)


def strips(scenes: Mapping[str, Segments], note: str = "") -> Figure:
    """A column for each scene (horizon, ...), by its title, and a row for each of `MOMENTS`."""
    figure, grid = panels_of(len(MOMENTS), len(scenes), 3.2, 0.8)
    for column, (title, scene) in enumerate(scenes.items()):
        for line, time in enumerate(MOMENTS):
            draw(grid[line, column], moment(scene, time))
            grid[line, column].set_ylabel(f"{time:g} s" if column == 0 else "", color=INK, fontsize=8)
        grid[0, column].set_title(title, color=INK, fontsize=9)
    if note:
        figure.supxlabel(note, color=INK, fontsize=8)
    return figure


def animate(scenes: Mapping[str, Segments], path: Path) -> None:
    """Writes a GIF: a road for each scene, by its title, and all of them at the same time."""
    from PIL import Image

    figure, grid = panels_of(len(scenes), 1, 6.0, 1.1)
    horizon = max(scene.mask.shape[0] for scene in scenes.values())
    pictures = []
    for time in np.arange(0, horizon + 0.5, 1 / FRAMES):
        for axes, (title, scene) in zip(grid[:, 0], scenes.items(), strict=True):
            draw(axes, moment(scene, float(time)))
            axes.set_title(title, color=INK, fontsize=9, loc="left")
        figure.canvas.draw()
        pictures.append(Image.fromarray(np.asarray(figure.canvas.buffer_rgba())[..., :3].copy()))
    first, *rest = pictures
    first.save(path, save_all=True, append_images=rest, duration=round(1000 / FRAMES), loop=0)
