"""What a method is: a value made of a few functions, so that training never asks which one it runs."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

from jax import Array

from peps_jax.config import Config
from peps_jax.trajectory import Preferences, Segments, Trajectory, Transition


class Method(NamedTuple):
    """What is learned in a round, which rewards SAC sees, and in which world.

    `knowledge` is whatever the method learns beside the policy (T_A, r-hat, ...), a pytree.
    """

    name: str
    uses_lam: bool  # whether lambda changes anything: a sweep trains a method without it once
    # (true parameters, belief) -> parameters of the world that it acts in, for learning and for evaluation
    world: Callable[[Any, Any], Any]
    init: Callable[[Array, Config], Any]  # (key, config) -> knowledge
    # (knowledge, trajectory, key, config) -> queries (n, 2, steps, ...), or None from a method that asks nothing
    ask: Callable[[Any, Trajectory, Array, Config], Segments | None]
    # (knowledge, replay, filled rows, preferences or None, round index, key, config) -> knowledge, info
    learn: Callable[[Any, Transition, Array, Preferences | None, Array, Array, Config], tuple[Any, dict[str, Array]]]
    # (knowledge, transitions, config) -> rewards, in reward units. One policy is learned for each, and they act by their product
    rewards: tuple[Callable[[Any, Transition, Config], Array], ...]
    entropy_weight: Callable[[Config], Array]  # of the policy entropy beside SAC's own temperature, in reward units


def true_world(params: Any, belief: Any) -> Any:
    """The world of every method that acts in the true dynamics."""
    del belief
    return params
