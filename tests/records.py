"""Records of trainings that nobody made."""

import numpy as np

from peps_jax.reproduce import store
from peps_jax.reproduce.store import Record

EPISODES = 4


def made_up(value: float, failed: bool = False, horizon: int = 6) -> Record:
    """A record whose every score is `value`."""
    names = ("return", "explicability", "human_return", "length", "goal_reached", "believed_return")
    figures = {name: np.full(EPISODES, value, np.float32) for name in names} | {"length": np.full(EPISODES, 5.0)}
    heat = {
        name: np.linspace(-value, value, 144).reshape(12, 12) ** power for name, power in (("learned", 1), ("true", 3))
    }
    routes = np.cumsum(np.full((store.ROUTES, horizon, 2), 0.5), 1)
    return Record(figures, figures, routes, heat | {"free": np.ones((12, 12), bool)}, failed, seconds=1.0)
