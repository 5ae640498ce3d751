"""What a method is: a value made of a few functions, so that training never asks which one it runs."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

from jax import Array

from peps_envs.registry import unknown_name
from peps_jax.config import Problem
from peps_jax.learning import sac, team
from peps_jax.learning.surrogate import SurrogateState
from peps_jax.preferences.data import PreferenceSet, Segments
from peps_jax.round import Round
from peps_jax.settings import AgentSettings, Settings
from peps_jax.trajectory import Trajectory, Transition


def each_acts(agents: tuple[sac.Agent, ...], observation: Array, key: Array, settings: AgentSettings) -> Array:
    """Actions (num_envs, ...) of the acting policy, in every environment."""
    return team.act(agents, observation, key, settings)[0]


class Method(NamedTuple):
    """What makes a method different: what it learns in a round, which rewards SAC sees, how it behaves, and in which domain.

    `knowledge` is whatever the method learns beside the policy (T_A, r-hat, ...), a pytree. The defaults are those of a method
    that learns nothing beside, asks nothing, and acts in the true domain: SAC.
    """

    name: str
    # (knowledge, transitions, settings) -> rewards, in reward units. One policy is learned for each, and they act by their product
    rewards: tuple[Callable[[Any, Transition, Settings], Array], ...]
    uses_lam: bool = False  # whether lambda changes anything: a sweep trains a method without it once
    asks: bool = False  # whether it asks a teacher
    acts_in: Callable[[Problem], Problem] = lambda problem: problem  # for learning and for evaluation
    settings: Callable[[Settings], Settings] = lambda settings: settings  # what the method has its own way
    init: Callable[[Array, Settings], Any] = lambda key, settings: ()  # (key, settings) -> knowledge
    # (knowledge, trajectory, round, settings) -> pairs of segments (n, 2, steps, ...) for the teacher; called if it asks
    ask: Callable[[Any, Trajectory, Round, Settings], Segments] | None = None
    # (knowledge, replay, preferences known by now, round, settings) -> knowledge, info
    learn: Callable[[Any, Transition, PreferenceSet | None, Round, Settings], tuple[Any, dict[str, Array]]] = (
        lambda knowledge, replay, preferences, now, settings: (knowledge, {})
    )
    # of the policy entropy beside SAC's own temperature, in reward units
    entropy_weight: Callable[[Settings], Array | float] = lambda settings: 0.0
    # (agents, observations (num_envs, ...), key, settings) -> actions (num_envs, ...) while it learns
    behave: Callable[[tuple[sac.Agent, ...], Array, Array, AgentSettings], Array] = each_acts
    # knowledge -> r-hat; None of a method that learns none
    surrogate: Callable[[Any], SurrogateState | None] = lambda knowledge: None


METHODS: dict[str, Method] = {}  # by name, in the order in which they were registered


def register(method: Method) -> Method:
    """Gives a method its name for `Config` and the commands.

    Raises:
      ValueError: another method has that name.
    """
    if METHODS.setdefault(method.name, method) is not method:
        raise ValueError(f"method {method.name!r} is registered already: choose another name")
    return method


def get(name: str) -> Method:
    """The method called `name`.

    Raises:
      ValueError: no such method; the message says the nearest.
    """
    if name not in METHODS:
        raise ValueError(unknown_name("method", name, METHODS))
    return METHODS[name]
