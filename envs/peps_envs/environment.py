"""What every world offers: code that makes a step, and parameters that say whose dynamics it follows.

The agent's MDP and the human's share states, actions, start and horizon and differ in dynamics and reward. So an
`Environment` is code, and what differs is a pytree of parameters: `params` for the true domain, `belief` for the human's.
Every method below takes either. All are written for one state, for `jax.vmap` to batch.
"""

from __future__ import annotations

import abc
import dataclasses
import math
from typing import Any, NamedTuple

import jax.numpy as jnp
from jax import Array


@dataclasses.dataclass(frozen=True)
class Box:
    """Actions in [-1, 1]^size."""

    size: int

    @property
    def uniform_entropy(self) -> float:
        """Differential entropy of the uniform policy, in nats."""
        return self.size * math.log(2.0)


@dataclasses.dataclass(frozen=True)
class Discrete:
    """Actions 0, ..., size - 1."""

    size: int

    @property
    def uniform_entropy(self) -> float:
        """Entropy of the uniform policy, in nats."""
        return math.log(self.size)


ActionSpace = Box | Discrete


class Step(NamedTuple):
    """What one step of a world returns. `terminated` and `truncated` are never merged."""

    state: Any  # the next state, a pytree
    observation: Array  # (observation_size,) of the next state
    reward: Array  # () float
    terminated: Array  # () bool, the MDP ended: nothing follows
    truncated: Array  # () bool, time ran out: the MDP would have gone on
    events: Array  # (len(event_names),) bool, what happened in this step


class NextState(abc.ABC):
    """Distribution of the next state as perceived: the dynamics T convolved with the kernel K = N(0, sigma_p^2 I).

    Nobody sees a position exactly. Comparing through a kernel keeps every log-density finite, for a deterministic model too,
    and log K(0) is the base measure that makes a perfect prediction score 0.
    """

    @abc.abstractmethod
    def log_prob(self, perceived: Array) -> Array:
        """log (T * K)(perceived | state, action), for `perceived` of shape (perceived_size,)."""

    @abc.abstractmethod
    def relative_log_prob(self, perceived: Array) -> Array:
        """l(s'|s,a) = log (T * K)(s'|s,a) - log K(0) <= 0; 0 where a deterministic model predicts s' exactly."""

    @abc.abstractmethod
    def relative_entropy(self) -> Array:
        """Environment entropy against the kernel, sum_i 1/2 log(1 + var_i / sigma_p^2); 0 where T is deterministic."""

    @abc.abstractmethod
    def sample(self, key: Array) -> Array:
        """A perceived next state, of shape (perceived_size,)."""

    @abc.abstractmethod
    def quadrature(self, points: int) -> tuple[Array, Array]:
        """Weights (n,) that sum to 1 and next states (n, perceived_size): E[f(s')] = sum_k weights[k] f(states[k]), T alone."""


class Environment(abc.ABC):
    """A world as pure functions. Subclasses are frozen dataclasses: equal fields mean the same code, so one compiled program.

    `horizon` (steps) is part of the code, because it bounds loops. `event_names` names the entries of `Step.events`.
    """

    horizon: int
    observation_size: int
    action_space: ActionSpace
    event_names: tuple[str, ...] = ()

    @abc.abstractmethod
    def reset(self, key: Array, params: Any) -> tuple[Any, Array]:
        """A start state and its observation."""

    @abc.abstractmethod
    def step(self, key: Array, state: Any, action: Array, params: Any) -> Step:
        """One step of the dynamics in `params`: the true ones, or what the human imagines."""

    @abc.abstractmethod
    def reward(self, state: Any, action: Array, next_state: Any, params: Any) -> Array:
        """r(s, a, s') with the reward weights in `params`: r_A of the true parameters, r_H of a belief."""

    @abc.abstractmethod
    def next_state_distribution(self, state: Any, action: Array, params: Any) -> NextState:
        """T * K at (state, action), which scores what was perceived."""

    @abc.abstractmethod
    def perceive(self, state: Any) -> Array:
        """The part of a state that people compare, (perceived_size,), in the units of `perception_width`."""

    @abc.abstractmethod
    def perceive_observation(self, observation: Array, params: Any) -> Array:
        """The same from an observation: an agent that learns dynamics has nothing else."""

    @abc.abstractmethod
    def perception_width(self, params: Any) -> Array:
        """sigma_p, the perceptual kernel's standard deviations, (perceived_size,)."""


def event(environment: Environment, events: Array, name: str) -> Array:
    """The entry of `events` (..., len(event_names)) that is called `name`.

    Raises:
      ValueError: the environment has no such event.
    """
    if name not in environment.event_names:
        raise ValueError(
            f"event {name!r}: {type(environment).__name__} has {', '.join(environment.event_names) or 'none'}"
        )
    return jnp.asarray(events)[..., environment.event_names.index(name)]
