"""Settings of a training: one frozen pytree.

What changes shapes or program structure is static: `jax.jit(train)` compiles once for each. Everything else is a traced leaf,
so `jax.vmap(train)` takes a `Config` with batched leaves.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

import peps_envs
from peps_envs.registry import unknown_name

STRATEGIES = ("information_gain", "disagreement", "random")
LEVELS = ("none", "quantile", "max", "standard")


def _static(default: Any, text: str, **metadata: Any) -> Any:
    return struct.field(pytree_node=False, default=default, metadata={"help": text, **metadata})


def _traced(default: Any, text: str, **metadata: Any) -> Any:
    return struct.field(default=default, metadata={"help": text, **metadata})


@struct.dataclass
class Config:
    """One training. Rewards and temperatures are in the environment's reward units; rates are per gradient step.

    `env` is a name ("nav-d1") or an `Environment`; then `params` and `belief` have to be given. `belief` is a name that the
    task knows ("biased", "unbiased", ...) or a pytree of parameters. `check()` raises ValueError for values that make no sense.
    """

    env: Any = _static("nav-d1", "the world", group="task")
    method: str = _static(
        "peps",
        "what is learned, and from which reward: peps, sac, drlhp, policy_shaping or human_expectation",
        group="task",
    )
    seed: Any = _traced(0, "random seed", group="task")
    params: Any = _traced(None, "true parameters of the world (default: the task's)", group="task", flag=False)
    belief: Any = _traced(None, "what the human believes (default: the task's first belief)", group="task")

    # Eq. (6)
    lam: Any = _traced(2.4, "reconciliation parameter: weight of explicability against return", group="objective")
    surrogate_weight: Any = _traced(1.0, "weight of the surrogate reward in Eq. (6)", group="objective")
    environment_entropy_weight: Any = _traced(1.0, "weight of the environment entropy in Eq. (6)", group="objective")
    policy_entropy_weight: Any = _traced(0.3, "weight of the policy entropy in Eq. (6)", group="objective")
    gamma: Any = _traced(0.995, "discount", group="objective")

    total_steps: int = _static(40_000, "environment steps in all", group="run")
    num_envs: int = _static(16, "environments side by side", group="run")
    rollout_length: int = _static(25, "steps that each environment makes in a round", group="run")
    warmup_steps: int = _static(3_200, "environment steps with uniformly random actions at the start", group="run")
    exploration: Any = _traced(0.2, "share of the steps after that with such actions", group="run")
    hold_steps: int = _static(5, "steps for which such an action is held", group="run")

    learning_rate: Any = _traced(1e-3, "Adam's rate for policy and critics", group="sac")
    fade_share: Any = _traced(
        0.3, "share of the rounds, at the end, over which that rate falls to a tenth", group="sac"
    )
    temperature: Any = _traced(
        0.02, "weight of the policy entropy beside Eq. (6)'s, at the end (in reward units)", group="sac"
    )
    initial_temperature: Any = _traced(3.0, "the same at the start: exploration fades", group="sac")
    anneal_share: Any = _traced(0.8, "share of the rounds over which the temperature fades", group="sac")
    saturation_penalty: Any = _traced(0.02, "price of a squared action before tanh (in reward units)", group="sac")
    tune_temperature: bool = _static(False, "tune the temperature to a target entropy instead", group="sac")
    target_rate: Any = _traced(0.01, "share of the critics that the targets take over at an update", group="sac")
    reward_scale: Any = _traced(0.1, "what rewards are multiplied by before the critics see them", group="sac")
    updates_per_step: float = _static(0.25, "SAC updates per environment step", group="sac")
    batch_size: int = _static(256, "transitions in a minibatch", group="sac")
    hidden_sizes: tuple[int, ...] = _static((64, 64), "hidden layers of policy and critics", group="sac")

    ensemble_size: int = _static(5, "members of the dynamics and of the surrogate ensemble", group="models")
    model_hidden_sizes: tuple[int, ...] = _static(
        (32, 32), "hidden layers of dynamics and surrogate networks", group="models"
    )
    dynamics_learning_rate: Any = _traced(1e-3, "Adam's rate for the dynamics", group="models")
    dynamics_updates: int = _static(20, "gradient steps on the dynamics in a round", group="models")
    surrogate_learning_rate: Any = _traced(5e-3, "Adam's rate for the surrogate reward", group="models")
    surrogate_updates: int = _static(40, "gradient steps on the surrogate reward in a round", group="models")
    surrogate_batch_size: int = _static(64, "preferences in a minibatch of the surrogate's fit", group="models")
    surrogate_decay: Any = _traced(1e-4, "weight decay of the surrogate's fit", group="models")
    level: str = _static(
        "none", f"what pins the surrogate reward's level after the fit: {', '.join(LEVELS)}", group="models"
    )

    num_queries: int = _static(3_000, "preferences that the teacher gives in all", group="queries")
    segment_length: int = _static(5, "steps of the longest segment", group="queries")
    min_segment_length: int = _static(
        2, "steps of the shortest segment (unequal lengths pin the level)", group="queries"
    )
    query_strategy: str = _static(
        "information_gain", f"how queries are chosen: {', '.join(STRATEGIES)}", group="queries"
    )
    candidates_per_query: int = _static(10, "candidate pairs for each query asked", group="queries")

    rationality: Any = _traced(1.0, "the human's coefficient on the difference in Eq. (2)'s exponents", group="human")
    myopia: Any = _traced(
        1.0, "discount towards a segment's past: below 1 the human weighs its end more", group="human"
    )
    mistake_rate: Any = _traced(0.0, "probability of the opposite answer", group="human")
    indifference: Any = _traced(0.0, "difference below which the human calls it a tie", group="human")
    skip_below: Any = _traced(-np.inf, "sum under which both segments make the human skip the query", group="human")

    def __post_init__(self):
        if isinstance(self.belief, str):
            beliefs = peps_envs.make(self.env).beliefs
            if self.belief not in beliefs:
                raise ValueError(unknown_name("belief", self.belief, beliefs))
            object.__setattr__(self, "belief", beliefs[self.belief])

    def task(self) -> tuple[peps_envs.Environment, Any, Any]:
        """The environment, its true parameters and the human's belief.

        Raises:
          ValueError: no environment of that name, or an environment object without `params` and `belief`.
        """
        if isinstance(self.env, peps_envs.Environment):
            for field in ("params", "belief"):
                if getattr(self, field) is None:
                    raise ValueError(f"{field} is None: give it when env is an Environment object")
            return self.env, self.params, self.belief
        task = peps_envs.make(self.env)
        params = task.params if self.params is None else self.params
        belief = task.beliefs[task.default_belief] if self.belief is None else self.belief
        return task.environment, params, belief

    @property
    def steps_per_round(self) -> int:
        """Environment steps in a round."""
        return self.num_envs * self.rollout_length

    @property
    def num_rounds(self) -> int:
        """Rounds in a training; the last one may go past `total_steps`."""
        return -(-self.total_steps // self.steps_per_round)

    @property
    def warmup_rounds(self) -> int:
        return -(-self.warmup_steps // self.steps_per_round)

    @property
    def updates_per_round(self) -> int:
        """SAC updates in a round."""
        return max(1, round(self.steps_per_round * self.updates_per_step))

    @property
    def queries_per_round(self) -> int:
        """Queries asked in each round until the budget is spent."""
        return -(-self.num_queries // self.num_rounds)

    def check(self) -> None:
        """Raises ValueError, in one line, for the first field whose value makes no sense. Traced values are not looked at."""
        self.task()
        _check_choice("query_strategy", self.query_strategy, STRATEGIES)
        _check_choice("level", self.level, LEVELS)
        for name in (
            "total_steps", "num_envs", "rollout_length", "batch_size", "ensemble_size", "dynamics_updates",
            "surrogate_updates", "surrogate_batch_size", "num_queries", "segment_length", "min_segment_length",
            "candidates_per_query", "hold_steps",
        ):  # fmt: skip
            _require(
                name,
                getattr(self, name),
                lambda value: isinstance(value, int) and value >= 1,
                "a whole number from 1 on",
            )
        _require("warmup_steps", self.warmup_steps, lambda value: value >= 0, "0 or more")
        _require("updates_per_step", self.updates_per_step, lambda value: value > 0, "above 0")
        for name in ("hidden_sizes", "model_hidden_sizes"):
            sizes = getattr(self, name)
            _require(
                name,
                sizes,
                lambda value: len(value) > 0 and all(size >= 1 for size in value),
                "one or more sizes from 1 on",
            )
        if self.segment_length > self.rollout_length:
            raise ValueError(
                f"segment_length {self.segment_length} is longer than what a round collects: "
                f"rollout_length is {self.rollout_length} steps; choose at most that"
            )
        if self.min_segment_length > self.segment_length:
            raise ValueError(
                f"min_segment_length {self.min_segment_length} exceeds segment_length {self.segment_length}"
            )
        if self.candidates_per_query < 10:
            raise ValueError(
                f"candidates_per_query {self.candidates_per_query}: choose 10 or more, or the choice is no choice"
            )
        for name in (
            "lam", "temperature", "saturation_penalty", "initial_temperature", "rationality", "indifference",
            "surrogate_decay", "surrogate_weight", "environment_entropy_weight", "policy_entropy_weight",
        ):  # fmt: skip
            _require(name, getattr(self, name), lambda value: value >= 0, "0 or more")
        for name in ("gamma", "myopia", "mistake_rate", "target_rate", "anneal_share", "exploration"):
            _require(name, getattr(self, name), lambda value: (value >= 0) & (value <= 1), "from 0 to 1")
        for name in ("learning_rate", "dynamics_learning_rate", "surrogate_learning_rate", "reward_scale"):
            _require(name, getattr(self, name), lambda value: value > 0, "above 0")
        _require("seed", self.seed, lambda value: value >= 0, "a whole number from 0 on")


def _check_choice(field: str, value: str, known: tuple[str, ...]) -> None:
    if value not in known:
        raise ValueError(unknown_name(field, value, known))


def _require(field: str, value: Any, holds: Any, right: str) -> None:
    if isinstance(value, jax.core.Tracer):
        return
    try:
        good = bool(np.all(holds(np.asarray(value) if not isinstance(value, (int, tuple)) else value)))
    except TypeError:
        good = False
    if not good:
        raise ValueError(f"{field} {value!r} is out of range: choose {right}")


def grid(config: Config, **leaves: Any) -> Config:
    """A `Config` whose every traced leaf has a leading axis, for `jax.vmap(train)`: `leaves` vary, the others are repeated.

    `leaves` are sequences of one length, for traced fields: `grid(config, seed=[0, 1], lam=[2.0, 2.4])` has two cells.

    Raises:
      ValueError: a static or unknown field, or sequences of different lengths.
    """
    fields = {field.name: field for field in dataclasses.fields(config)}
    for name in leaves:
        if name not in fields:
            raise ValueError(unknown_name("field", name, fields))
        if not fields[name].metadata.get("pytree_node", True):
            raise ValueError(
                f"{name} is static: it changes the program, so its values can't share one; train each by itself"
            )
    batched = {name: jax.tree.map(jnp.asarray, value) if name in ("params", "belief") else jnp.asarray(value)
               for name, value in leaves.items()}  # fmt: skip
    sizes = {leaf.shape[0] for value in batched.values() for leaf in jax.tree.leaves(value)}
    if len(sizes) != 1:
        raise ValueError(f"{', '.join(leaves)} have lengths {sorted(sizes)}: give all of them one length")
    (size,) = sizes
    repeated = jax.tree.map(lambda leaf: jnp.broadcast_to(jnp.asarray(leaf), (size, *jnp.shape(leaf))), config)
    return repeated.replace(**batched)
