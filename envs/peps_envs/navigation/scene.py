"""What there is to see of a navigation domain: its ground, and the agent on it."""

from __future__ import annotations

import numpy as np
from jax import Array

from peps_envs.navigation.parameters import NavigationParams
from peps_envs.scene import Circle, Scene, area

BORDER = 0.12  # arena units of the wall around the arena that are in view
FIRM = 0.5  # gain on sand from which it is drawn as in the paper's D4, darker: the agent can walk on it
RADIUS = 0.15  # arena units, of the agent's mark


def ground(params: NavigationParams) -> Scene:
    """The arena without the agent: its floor, the areas on it, and a little of the wall around it."""
    width, height = (float(length) for length in np.asarray(params.size))
    sand = "firm sand" if params.sand_gain >= FIRM else "sand"
    areas = [("ice", params.ice), (sand, params.sand), ("pit", params.pit), ("goal", params.goal)]
    areas += [("wall", wall) for wall in np.asarray(params.walls)]
    areas = [area(np.asarray(bounds), name) for name, bounds in areas if bounds[2] > 0 and bounds[3] > 0]  # not nowhere
    extent = (-BORDER, width + BORDER, -BORDER, height + BORDER)
    floor = area((0.0, 0.0, width, height), "floor")
    return Scene((floor, *areas), extent, y_down=True, background="wall")


def agent(position: Array) -> Circle:
    """The mark of who is at `position` (2,)."""
    x, y = (float(place) for place in np.asarray(position))
    return Circle(x, y, RADIUS, "agent", outline="ink")
