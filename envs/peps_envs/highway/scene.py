"""What there is to see of the road: its lanes and the cars on it, from a view that goes along with the ego."""

from __future__ import annotations

import math

import numpy as np

from peps_envs.highway.vehicle import LANE_WIDTH, LENGTH, WIDTH, Vehicles
from peps_envs.scene import Polyline, Rectangle, Scene

BEHIND, AHEAD = 20.0, 60.0  # m of the road in sight of the ego
DASH, PERIOD = 5.0, 12.0  # m, of the line between two lanes: a dash, and from one to the next
SHOULDER = 0.1 * LANE_WIDTH  # m in view beside the road


def road_scene(vehicles: Vehicles, lanes: int) -> Scene:
    """The road around the ego, which is the agent; who has crashed is a wreck."""
    ego = float(np.asarray(vehicles.x)[0])
    left, right = ego - BEHIND, ego + AHEAD
    top, bottom = -LANE_WIDTH / 2, (lanes - 0.5) * LANE_WIDTH
    shapes = [*_lines(left, right, lanes), *_cars(vehicles)]
    return Scene(tuple(shapes), (left, right, top - SHOULDER, bottom + SHOULDER), y_down=True, background="road")


def _lines(left: float, right: float, lanes: int) -> list[Polyline]:
    """The road's edges, and dashes between lanes that stay on the road while the view moves along it."""
    place = lambda line: (line - 0.5) * LANE_WIDTH
    edges = [Polyline(((left, place(line)), (right, place(line))), "edge line") for line in (0, lanes)]
    starts = np.arange(math.floor(left / PERIOD) * PERIOD, right, PERIOD).tolist()
    dashes = [
        Polyline(((start, place(line)), (start + DASH, place(line))), "lane line")
        for line in range(1, lanes)
        for start in starts
    ]
    return edges + dashes


def _cars(vehicles: Vehicles) -> list[Rectangle]:
    rows = zip(*(np.asarray(leaf).tolist() for leaf in (vehicles.x, vehicles.y, vehicles.heading)), strict=True)
    crashed = np.asarray(vehicles.crashed)
    role = lambda car: "wreck" if crashed[car] else "other" if car else "agent"
    return [
        Rectangle(x, y, LENGTH, WIDTH, role(car), angle=heading, outline="ink")
        for car, (x, y, heading) in enumerate(rows)
    ]
