"""What a method is: a value made of a few functions, so that training never asks which one it runs."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

from jax import Array

from peps_jax.config import Config
from peps_jax.parts.trajectory import Preferences, Segments, Trajectory, Transition


class Method(NamedTuple):
    """What is learned in a round, the reward that SAC sees, and how the acting policy is made.

    `knowledge` is whatever the method learns beside the policy (T_A, r-hat, ...), a pytree.
    """

    name: str
    uses_lam: bool  # whether lambda changes anything: a sweep trains a method without it once
    init: Callable[[Array, Config], Any]  # (key, config) -> knowledge
    # (knowledge, trajectory, key, config) -> queries (n, 2, steps, ...), or None from a method that asks nothing
    ask: Callable[[Any, Trajectory, Array, Config], Segments | None]
    # (knowledge, replay, filled rows, preferences or None, round index, key, config) -> knowledge, info
    learn: Callable[[Any, Transition, Array, Preferences | None, Array, Array, Config], tuple[Any, dict[str, Array]]]
    # (knowledge, transitions, config) -> rewards, in reward units
    reward: Callable[[Any, Transition, Config], Array]
    entropy_weight: Callable[[Config], Array]  # of the policy entropy beside SAC's own temperature, in reward units
