"""What every environment offers: code that makes a step, and parameters that say whose dynamics it follows.

The agent's MDP and the human's share states, actions, start and horizon and differ in dynamics and reward. So an
`Environment` is code, and what differs is a pytree of parameters: `params` for the true domain, `belief` for the human's.
Every method below takes either. All are written for one state, for `jax.vmap` to batch.
"""

from __future__ import annotations

import abc
import dataclasses
import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from peps_envs.perception import Gaussian, Mixture, PerceivedDensity
from peps_envs.scene import Scene


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


@dataclasses.dataclass(frozen=True)
class Bounds:
    """Closed limits of an observation: a number each, or one for every feature; infinite where there is none."""

    low: float | tuple[float, ...] = -math.inf
    high: float | tuple[float, ...] = math.inf


class Step(NamedTuple):
    """What one step of an environment returns. `terminated` and `truncated` are never merged."""

    state: Any  # the next state, a pytree
    observation: Array  # (observation_size,) of the next state
    reward: Array  # () float
    terminated: Array  # () bool, the MDP ended: nothing follows
    truncated: Array  # () bool, time ran out: the MDP would have gone on
    events: Array  # (len(event_names),) bool, what happened in this step


class Judgement(NamedTuple):
    """What a human thinks of a step that happened, and how well the truth itself predicts it."""

    human_reward: Array  # () r_H(s, a, s')
    log_belief: Array  # () l_H(s'|s, a)
    log_true: Array  # () l_A(s'|s, a)
    imagined: Array  # (perceived_size,) a next state as the human imagines it, drawn from T_H * K


class Environment(abc.ABC):
    """An MDP as pure functions. Subclasses are frozen dataclasses: equal fields mean the same code, so one compiled program.

    What is abstract here is all that an environment owes. `horizon` (steps) is part of the code, because it bounds loops.
    """

    horizon: int
    observation_size: int
    action_space: ActionSpace
    observation_space: Bounds = Bounds()
    event_names: tuple[str, ...] = ()  # of the entries of `Step.events`
    random_draws: int = 1  # steps from which `next_state_distribution` is made; more than one where chance is in them

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
    def perceive(self, state: Any) -> Array:
        """The part of a state that people compare, (perceived_size,), in the units of `perception_width`."""

    @abc.abstractmethod
    def perception_width(self, params: Any) -> Array:
        """sigma_p, the perceptual kernel's standard deviations, (perceived_size,)."""

    def next_state_distribution(self, state: Any, action: Array, params: Any) -> PerceivedDensity:
        """T * K at (state, action), which scores what was perceived: the step under `params`, seen through the kernel.

        Exact where a step has no chance in it, l = -1/2 sum(((s' - outcome) / sigma_p)^2). Where it has, `random_draws` steps
        with fixed keys stand for T as equally likely outcomes: an approximation, in which the same chances are compared at
        every state and under all parameters. Who knows T better overrides this.
        """
        see = lambda key: self.perceive(self.step(key, state, action, params).state)
        key = jax.random.key(0)
        if self.random_draws == 1:
            outcome = see(key)
            return Gaussian(outcome, jnp.zeros_like(outcome), self.perception_width(params))
        outcomes = jax.vmap(see)(jax.random.split(key, self.random_draws))
        weights = jnp.full(self.random_draws, 1 / self.random_draws, outcomes.dtype)
        return Mixture(outcomes, weights, self.perception_width(params))

    def judged_step(self, key: Array, state: Any, action: Array, params: Any, belief: Any) -> tuple[Step, Judgement]:
        """`step` under `params`, and what a human who believes `belief` thinks of what happened.

        Who can make steps under two parameter sets at once for less than two overrides this.
        """
        expects = lambda params: self.next_state_distribution(state, action, params)
        densities = jax.vmap(expects)(side_by_side(belief, params))  # both at once: a density stands once in a program
        density_of = lambda place: jax.tree.map(lambda rows: rows[place], densities)
        after = self.step_from(density_of(1), key, state, action, params)
        perceived = self.perceive(after.state)
        log_belief, log_true = jax.vmap(lambda density: density.relative_log_prob(perceived))(densities)
        imagined = density_of(0).sample(jax.random.fold_in(key, 1))
        human_reward = self.reward(state, action, after.state, belief)
        return after, Judgement(human_reward, log_belief, log_true, imagined)

    def step_from(self, density: PerceivedDensity, key: Array, state: Any, action: Array, params: Any) -> Step:
        """`step`, where the density of what it leads to is known: an environment whose steps are drawn from it overrides this."""
        del density
        return self.step(key, state, action, params)

    def judged_steps(
        self, keys: Array, states: Any, actions: Array, params: Any, belief: Any, watched: int
    ) -> tuple[Step, Judgement]:
        """A step of each of n environments side by side, and what the human thinks of those in the first `watched` of them.

        All arguments but the parameters have a leading axis of n; so has what happened, (n, ...). Judgements are (watched, ...).
        """
        judge = lambda key, state, action: self.judged_step(key, state, action, params, belief)
        after, judged = jax.vmap(judge)(*first(watched, (keys, states, actions)))
        if watched == actions.shape[0]:
            return after, judged
        others = jax.tree.map(lambda rows: rows[watched:], (keys, states, actions))
        unseen = jax.vmap(lambda key, state, action: self.step(key, state, action, params))(*others)
        return jax.tree.map(lambda *rows: jnp.concatenate(rows), after, unseen), judged

    def scene(self, state: Any, params: Any) -> Scene | None:
        """What there is to see of `state`; None of an environment that has no picture. NumPy in, plain Python out: not traced."""
        del state, params
        return None


def first(number: int, tree: Any) -> Any:
    """The first `number` rows of every leaf."""
    return jax.tree.map(lambda rows: rows[:number], tree)


def side_by_side(*params: Any) -> Any:
    """Parameter sets of one structure along a leading axis, for `jax.vmap`."""
    return jax.tree.map(lambda *leaves: jnp.stack(jnp.broadcast_arrays(*leaves)), *params)


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
