"""What environments share that are made of another ecosystem's simulator: what is carried, and what is checked at the door.

The simulator is code, what it is told (parameters, a system, a compiled model) is data: the true one and the believed one are two
values of one structure, so that one program serves both.
"""

from __future__ import annotations

import abc
import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array

from peps_envs.environment import ActionSpace, Bounds, Discrete, Environment, Judgement, Step, first, side_by_side
from peps_envs.perception import Gaussian, PerceivedDensity


@struct.dataclass
class SimulatedState:
    """The simulator's own state, and what the last step was worth."""

    inner: Any
    reward: Array  # () of the step that led here
    time: Array  # () int, steps since the start


@dataclasses.dataclass(frozen=True)
class Structure:
    """What all values of the parameters share: the tree with everything in it that isn't an array, and the arrays' shapes."""

    tree: Any
    shapes: tuple[tuple[int, ...], ...]

    def check(self, params: Any, whose: str) -> None:
        """Raises ValueError, in one line that says where `params` differ."""
        if self.of(params) != self:
            other = jax.tree.unflatten(self.tree, self.shapes)
            raise ValueError(f"{whose}: parameters of another structure ({_difference(other, params)}) need another program; "
                             "give all of them the same one")  # fmt: skip

    @classmethod
    def of(cls, params: Any) -> Structure:
        return cls(jax.tree.structure(params), tuple(jnp.shape(leaf) for leaf in jax.tree.leaves(params)))


@dataclasses.dataclass(frozen=True, kw_only=True)
class Simulator(Environment):
    """An environment whose steps another ecosystem makes.

    Attributes:
      see: (the simulator's state) -> what people compare of it, (perceived_size,).
      width: sigma_p of that.
      reward_of: (state, action, next state, parameters) -> reward. None: what the simulator paid for the step, whoever judges it.
      structure: of all its parameters.
      name: of the simulator, for messages.
    """

    horizon: int
    observation_size: int
    action_space: ActionSpace
    observation_space: Bounds
    random_draws: int
    see: Callable[[Any], Array]
    width: tuple[float, ...]
    reward_of: Callable[[Any, Array, Any, Any], Array] | None
    structure: Structure
    name: str

    @abc.abstractmethod
    def start(self, key: Array, params: Any) -> tuple[Any, Array]:
        """The simulator's state at the start, and its observation."""

    @abc.abstractmethod
    def advance(self, key: Array, inner: Any, action: Array, params: Any) -> tuple[Any, Array, Array, Array]:
        """The simulator's next state, its observation, what it pays, and whether the MDP ended."""

    def happened(self, inner: Any) -> Array:
        """(len(event_names),) bool, the events of the step that led to a state of the simulator."""
        del inner
        return jnp.zeros(0, bool)

    def reset(self, key: Array, params: Any) -> tuple[SimulatedState, Array]:
        self.structure.check(params, self.name)
        inner, observation = self.start(key, params)
        action = jax.eval_shape(self._still)
        after, seen, reward, _ = jax.eval_shape(self.advance, key, inner, action, params)
        # simulators start from Python's numbers, and from scalars where they go on with arrays
        inner = jax.tree.map(_as, inner, after)
        return SimulatedState(inner, jnp.zeros((), reward.dtype), jnp.zeros((), jnp.int32)), _as(observation, seen)

    def step(self, key: Array, state: SimulatedState, action: Array, params: Any) -> Step:
        self.structure.check(params, self.name)
        inner, observation, reward, terminated = self.advance(key, state.inner, action, params)
        inner = jax.tree.map(_as, inner, state.inner)
        if self.reward_of is not None:
            reward = self.reward_of(state.inner, action, inner, params)
        after = SimulatedState(inner, jnp.asarray(reward, state.reward.dtype).reshape(()), state.time + 1)
        terminated = jnp.asarray(terminated, bool).reshape(())
        truncated = (after.time >= self.horizon) & ~terminated
        return Step(after, observation, after.reward, terminated, truncated, self.happened(inner))

    def judged_step(
        self, key: Array, state: SimulatedState, action: Array, params: Any, belief: Any
    ) -> tuple[Step, Judgement]:
        """A simulator without chance steps in truth and in the belief side by side: its step stands once in a program."""
        if self.random_draws > 1:
            return super().judged_step(key, state, action, params, belief)
        states = side_by_side(state, self.adopted(state, belief))
        step = lambda state, params: self.step(key, state, action, params)
        both = jax.vmap(step)(states, side_by_side(params, belief))
        of = lambda which: jax.tree.map(lambda rows: rows[which], both)
        after, imagined = of(0), of(1)
        return after, self._judgement(key, state, action, after, imagined, belief)

    def judged_steps(
        self, keys: Array, states: SimulatedState, actions: Array, params: Any, belief: Any, watched: int
    ) -> tuple[Step, Judgement]:
        """One batch of n steps in truth and `watched` in the belief, each row with its own parameters.

        Quicker than two batches side by side, each with parameters of its own: MuJoCo's box takes two thirds of the time.
        """
        if self.random_draws > 1:
            return super().judged_steps(keys, states, actions, params, belief, watched)
        number = actions.shape[0]
        seen = first(watched, (keys, states, actions))
        imagining = jax.vmap(self.adopted, in_axes=(0, None))(seen[1], belief)
        batch = jax.tree.map(
            lambda *rows: jnp.concatenate(rows), (keys, states, actions), (seen[0], imagining, seen[2])
        )
        believes = jnp.arange(number + watched) >= number
        rows = jax.tree.map(lambda leaf: leaf[believes.astype(jnp.int32)], side_by_side(params, belief))
        stepped = jax.vmap(self.step)(*batch, rows)
        after, imagined = first(number, stepped), jax.tree.map(lambda rows: rows[number:], stepped)
        judge = jax.vmap(self._judgement, in_axes=(0, 0, 0, 0, 0, None))
        return after, judge(*seen, first(watched, after), imagined, belief)

    def _judgement(
        self, key: Array, state: SimulatedState, action: Array, after: Step, imagined: Step, belief: Any
    ) -> Judgement:
        """Of a step without chance, which the human imagined to end in `imagined`."""
        expected = self.perceive(imagined.state)
        density = Gaussian(expected, jnp.zeros_like(expected), self.perception_width(belief))
        log_belief = density.relative_log_prob(self.perceive(after.state))
        human_reward = self.reward(state, action, after.state, belief)
        drawn = density.sample(jax.random.fold_in(key, 1))
        return Judgement(human_reward, log_belief, jnp.zeros_like(log_belief), drawn)

    def next_state_distribution(self, state: SimulatedState, action: Array, params: Any) -> PerceivedDensity:
        return super().next_state_distribution(self.adopted(state, params), action, params)

    def adopted(self, state: SimulatedState, params: Any) -> SimulatedState:
        """`state`, whichever parameters it was made by, as one that `params` can go on from."""
        del params
        return state

    def reward(self, state: SimulatedState, action: Array, next_state: SimulatedState, params: Any) -> Array:
        if self.reward_of is None:
            return next_state.reward
        return jnp.asarray(self.reward_of(state.inner, action, next_state.inner, params)).reshape(())

    def perceive(self, state: SimulatedState) -> Array:
        return self.see(state.inner)

    def perception_width(self, params: Any) -> Array:
        return jnp.asarray(self.width)

    def _still(self) -> Array:
        """An action, for its shape."""
        if isinstance(self.action_space, Discrete):
            return jnp.zeros((), jnp.int32)
        return jnp.zeros(self.action_space.size)


def _as(leaf: Any, like: Any) -> Array:
    return jnp.asarray(leaf, like.dtype).reshape(like.shape)


def check_flat(observation: Any, name: str) -> None:
    """Raises ValueError for observations that no small network takes in."""
    leaves = jax.tree.leaves(observation)
    if not (len(leaves) == 1 and leaves[0] is observation):
        raise ValueError(
            f"{name}: observations in parts aren't supported; give `observe`, which makes one vector of a state"
        )
    if observation.ndim != 1:
        raise ValueError(
            f"{name}: observations of shape {observation.shape}, such as pixels, aren't supported; give `observe`, "
            "which makes one vector of a state"
        )


def _difference(wanted: Any, given: Any) -> str:
    """Names of the fields in which two parameter sets differ that aren't arrays' contents."""
    if type(wanted) is not type(given):
        return f"{type(given).__name__} for {type(wanted).__name__}"
    if not dataclasses.is_dataclass(wanted):
        return "its tree or the shapes of its arrays"
    names = []
    for field in dataclasses.fields(wanted):
        one, other = getattr(wanted, field.name), getattr(given, field.name)
        if isinstance(one, np.ndarray):
            same = np.array_equal(one, other)
        elif isinstance(one, tuple) and hasattr(other, "shape"):  # an array, of which the shape is kept
            same = one == other.shape
        elif isinstance(one, int | float | str | bytes | bool):
            same = one == other
        else:
            same = jax.tree.structure(one, is_leaf=_is_shape) == jax.tree.structure(other)
        names += [] if same else [field.name]
    return ", ".join(names[:4]) or "a field that isn't an array"


def _is_shape(value: Any) -> bool:
    return isinstance(value, tuple) and all(isinstance(part, int) for part in value)
