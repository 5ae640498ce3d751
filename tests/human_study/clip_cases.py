"""Segments whose clips are looked at: a drive, a walk, and a parade of all that a scene may do."""

import jax
import numpy as np
from conftest import Point

from peps_envs.environment import Environment
from peps_envs.scene import Circle, Polyline, Rectangle, Scene, Text


def before_and_after(rows):
    """The states (steps + 1, ...) before each step and after it."""
    return jax.tree.map(lambda leaf: leaf[:-1], rows), jax.tree.map(lambda leaf: leaf[1:], rows)


def drive(task, steps, speed=30.0, seed=0):
    """States of a drive at `speed` m/s that changes lane: (steps, ...) before and after each step."""
    state, _ = task.environment.reset(jax.random.key(seed), task.params)
    times = np.arange(steps + 1.0)
    cars = jax.tree.map(lambda leaf: np.repeat(np.asarray(leaf)[None], steps + 1, 0), state)
    x = cars.vehicles.x + times[:, None] * [speed, speed / 2]
    y = cars.vehicles.y - np.outer(np.clip(times - 1, 0, 2) * 2, [1, 0])
    heading = cars.vehicles.heading - np.outer((times > 1) & (times < 3), [0.08, 0.0])
    crashed = cars.vehicles.crashed | (times >= steps)[:, None]
    rows = cars.replace(vehicles=cars.vehicles.replace(x=x, y=y, heading=heading, crashed=crashed))
    return before_and_after(rows)


def walk(task, steps, seed=0):
    """States of a way through a navigation domain."""
    state, _ = task.environment.reset(jax.random.key(0), task.params)
    moves = np.random.default_rng(seed).normal(0.05, 0.4, (steps + 1, 2)) * (np.arange(steps + 1) > 0)[:, None]
    ways = np.clip(np.asarray(state.position) + np.cumsum(moves, 0), 0, 6)
    rows = state.replace(position=ways, time=np.arange(steps + 1))
    return before_and_after(rows)


class Parade(Environment):
    """Shows what no environment of ours does: things that come and go, change their text, stop, and lie under others."""

    reset = lambda self, key, params: (Point(np.zeros(1), np.zeros((), int)), None)
    step = reward = perceive = perception_width = None

    def scene(self, state, params):
        place, time = float(state.place[0]), int(state.time)
        shapes = [Rectangle(0.0, 0.0, 2.0, 1.0, "sand"), Circle(min(place, 1.0), 0.0, 0.3, "agent")]
        shapes += [
            Polyline(((0.0, 0.0), (place, 1.0)), "quiet"),
            Rectangle(1.0, -place / 2, 0.5, 0.5 + place / 4, "wall"),
        ]
        shapes += [Text(1.0, 0.5, f"step {time}")] if time >= 1 else []
        shapes += [Circle(3.0, 1.0, 0.1, "other")] if time < 2 else []
        return Scene(tuple(shapes), (-2.0, 4.0, -2.0, 2.0))


def parade(steps):
    rows = Point(0.5 * np.arange(steps + 1.0)[:, None], np.arange(steps + 1))
    return before_and_after(rows)
