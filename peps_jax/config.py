"""Settings of a training, as users write them: one flat, frozen pytree.

What changes shapes or program structure is static: `jax.jit(train)` compiles once for each. Everything else is a traced leaf,
so `jax.vmap(train)` takes a `Config` with batched leaves. A field's metadata has its help text, its group and what values are
right; checks and command-line flags follow from it. `peps_jax.settings` divides the fields among the parts that use them.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

import peps_envs
from peps_envs.registry import unknown_name
from peps_jax.fields import (
    CEILING,
    COUNT,
    COUNT_OR_NONE,
    FLOOR,
    LESS_THAN_ALL,
    NOT_NEGATIVE,
    POSITIVE,
    SHARE,
    SIZES,
    SWITCH,
    Range,
    check_single,
    check_value,
    shown,
    static,
    traced,
)  # fmt: skip

STRATEGIES = ("information_gain", "disagreement", "random")
LEVELS = ("none", "quantile", "max", "standard")
PRIORS = ("observed", "none")
PRODUCTS = ("candidates", "gaussians")
ENTROPIES = ("relative", "absolute")


@struct.dataclass
class Problem:
    """The MDP that the agent acts in, and the one that the human believes it acts in: one environment, two sets of parameters."""

    environment: peps_envs.Environment = struct.field(pytree_node=False)
    params: Any  # of the domain that the agent acts in
    belief: Any


def capacity(number: int) -> int:
    """Room for `number` of something: the next of 1, 2, 3, 4, 5, 6, 8, 10, 12, ...; what fits into one room shares a program."""
    scale = 10 ** max(0, len(str(number)) - 2)
    steps = (scale * size for size in (1, 2, 3, 4, 5, 6, 8, 10, 12, 15, 20, 25, 30, 40, 50, 60, 80, 100))
    return next(size for size in steps if size >= number)


@struct.dataclass
class Lengths:
    """How long a training is, as values: a program has room for more."""

    num_rounds: Any  # () int32
    warmup_rounds: Any  # () int32, whose actions are all random
    unasked_rounds: Any  # () int32, before the first query
    num_queries: Any  # () int32, asked in all


@struct.dataclass
class Config:
    """One training. Rewards and temperatures are in the environment's reward units; rates are per gradient step.

    `env` is a name ("nav-d1") or an `Environment`; then `params` and `belief` have to be given. `belief` is a name that the
    task knows ("biased", "unbiased", ...) or a pytree of parameters. `check()` raises ValueError for values that make no sense.
    """

    env: Any = static("nav-d1", None, "the environment", group="task")
    method: str = static(
        "peps",
        None,
        "what is learned, and from which reward: peps, sac, drlhp, policy_shaping, oracle, darc or human_expectation",
        group="task",
    )
    seed: Any = traced(0, COUNT_OR_NONE, "random seed", group="task")
    params: Any = traced(
        None, None, "true parameters of the environment (default: the task's)", group="task", flag=False
    )
    belief: Any = traced(None, None, "what the human believes (default: the task's first belief)", group="task")

    # Eq. (6)
    lam: Any = traced(
        2.4, NOT_NEGATIVE, "reconciliation parameter: weight of explicability against return", group="objective"
    )
    surrogate_weight: Any = traced(1.0, NOT_NEGATIVE, "weight of the surrogate reward in Eq. (6)", group="objective")
    environment_entropy_weight: Any = traced(
        1.0, NOT_NEGATIVE, "weight of the environment entropy in Eq. (6)", group="objective"
    )
    policy_entropy_weight: Any = traced(0.3, NOT_NEGATIVE, "weight of the policy entropy in Eq. (6)", group="objective")
    entropy_fade_share: Any = traced(
        0.1, SHARE, "share of the rounds, at the end, over which that weight falls to a tenth", group="objective"
    )
    entropies: str = static(
        "relative",
        ENTROPIES,
        "what Eq. (6)'s entropies are measured against: kernel and uniform policy (relative), or nothing (absolute)",
        group="objective",
    )
    gamma: Any = traced(0.995, SHARE, "discount", group="objective")

    total_steps: int = static(20_000, COUNT, "environment steps in all", group="run")
    num_envs: int = static(16, COUNT, "environments side by side", group="run")
    rollout_length: int = static(25, COUNT, "steps that each environment makes in a round", group="run")
    watched_every: int = static(
        1, COUNT, "of how many environments the human watches one, to be asked about and to judge", group="run"
    )
    warmup_steps: int = static(
        4_800, COUNT_OR_NONE, "environment steps with uniformly random actions at the start", group="run"
    )
    exploration: Any = traced(0.1, SHARE, "share of the steps after that with such actions", group="run")
    hold_steps: int = static(5, COUNT, "steps for which such an action is held", group="run")
    lengths: Any = traced(
        None,
        None,
        "rounds and queries as values, where total_steps and num_queries say for how many there is room "
        "(default: as many as there is room for)",
        group="run",
        flag=False,
    )

    learning_rate: Any = traced(3e-3, POSITIVE, "Adam's rate for policy and critics", group="sac")
    fade_share: Any = traced(
        0.3, SHARE, "share of the rounds, at the end, over which that rate falls to a tenth", group="sac"
    )
    temperature: Any = traced(
        0.02, NOT_NEGATIVE, "weight of the policy entropy beside Eq. (6)'s, at the end (in reward units)", group="sac"
    )
    initial_temperature: Any = traced(3.0, NOT_NEGATIVE, "the same at the start: exploration fades", group="sac")
    anneal_share: Any = traced(0.8, SHARE, "share of the rounds over which the temperature fades", group="sac")
    saturation_penalty: Any = traced(
        0.02, NOT_NEGATIVE, "price of a squared action before tanh (in reward units)", group="sac"
    )
    product: str = static(
        "candidates",
        PRODUCTS,
        f"how policy shaping's two policies act together: {', '.join(PRODUCTS)}",
        group="sac",
    )
    tune_temperature: bool = static(False, SWITCH, "tune the temperature to a target entropy instead", group="sac")
    target_rate: Any = traced(0.01, SHARE, "share of the critics that the targets take over at an update", group="sac")
    reward_scale: Any = traced(0.1, POSITIVE, "what rewards are multiplied by before the critics see them", group="sac")
    updates_per_step: float = static(0.5, POSITIVE, "SAC updates per environment step", group="sac")
    batch_size: int = static(128, COUNT, "transitions in a minibatch", group="sac")
    hidden_sizes: tuple[int, ...] = static((64, 64), SIZES, "hidden layers of policy and critics", group="sac")
    critic_normalisation: bool = static(True, SWITCH, "whether the critics' hidden layers are normalised", group="sac")

    ensemble_size: int = static(5, COUNT, "members of the dynamics and of the surrogate ensemble", group="models")
    model_hidden_sizes: tuple[int, ...] = static(
        (32, 32), SIZES, "hidden layers of dynamics and surrogate networks", group="models"
    )
    dynamics_learning_rate: Any = traced(1e-3, POSITIVE, "Adam's rate for the dynamics", group="models")
    dynamics_updates: int = static(20, COUNT, "gradient steps on the dynamics in a round", group="models")
    dynamics_batch_size: int = static(256, COUNT, "transitions in a minibatch of the dynamics' fit", group="models")
    surrogate_learning_rate: Any = traced(5e-3, POSITIVE, "Adam's rate for the surrogate reward", group="models")
    surrogate_updates: int = static(20, COUNT, "gradient steps on the surrogate reward in a round", group="models")
    surrogate_batch_size: int = static(
        32, COUNT, "answers in each member's minibatches of the surrogate's fit", group="models"
    )
    surrogate_decay: Any = traced(1e-4, NOT_NEGATIVE, "weight decay of the surrogate's fit", group="models")
    level: str = static(
        "none", LEVELS, f"what pins the surrogate reward's level after the fit: {', '.join(LEVELS)}", group="models"
    )

    prior: str = static(
        "observed",
        PRIORS,
        f"what PEPS's surrogate reward is learned as a difference from: {', '.join(PRIORS)}",
        group="models",
    )
    bound: float = static(
        1.0, CEILING, "most that it may be above that prior (in reward units; inf for no bound)", group="models"
    )
    uniform_answers: float = static(
        0.0, LESS_THAN_ALL, "share of the answers that its likelihood takes for random", group="models"
    )

    num_queries: int = static(300, COUNT_OR_NONE, "queries that the teacher is asked in all", group="queries")
    unasked_steps: int = static(
        0, COUNT_OR_NONE, "environment steps at the start, before the first query", group="queries"
    )
    segment_length: int = static(5, COUNT, "steps of the longest segment", group="queries")
    min_segment_length: int = static(
        2, COUNT, "steps of the shortest segment (unequal lengths pin the level)", group="queries"
    )
    query_strategy: str = static(
        "information_gain", STRATEGIES, f"how queries are chosen: {', '.join(STRATEGIES)}", group="queries"
    )
    candidates_per_query: int = static(
        10,
        Range(lambda value: COUNT.holds(value) & (value >= 10), "10 or more, or the choice is no choice"),
        "candidate pairs for each query asked",
        group="queries",
    )

    rationality: Any = traced(
        1.0, NOT_NEGATIVE, "the human's coefficient on the difference in Eq. (2)'s exponents", group="human"
    )
    myopia: Any = traced(
        1.0, SHARE, "discount towards a segment's past: below 1 the human weighs its end more", group="human"
    )
    informed: Any = traced(
        0.0, SHARE, "share of the answers by somebody who knows the true dynamics and reward", group="human"
    )
    mistake_rate: Any = traced(0.0, SHARE, "probability of the opposite answer", group="human")
    indifference: Any = traced(0.0, NOT_NEGATIVE, "difference below which the human calls it a tie", group="human")
    skip_below: Any = traced(
        -math.inf, FLOOR, "sum under which both segments make the human skip the query", group="human"
    )

    def __post_init__(self):
        if isinstance(self.belief, str):
            beliefs = peps_envs.make(self.env).beliefs
            if self.belief not in beliefs:
                raise ValueError(unknown_name("belief", self.belief, beliefs))
            object.__setattr__(self, "belief", beliefs[self.belief])

    def problem(self) -> Problem:
        """The environment, its true parameters and the human's belief, which `env`, `params` and `belief` name.

        Raises:
          ValueError: no environment of that name, or an environment object without `params` and `belief`.
        """
        if isinstance(self.env, peps_envs.Environment):
            for field in ("params", "belief"):
                if getattr(self, field) is None:
                    raise ValueError(f"{field} is None: give it when env is an Environment object")
            return Problem(self.env, self.params, self.belief)
        task = peps_envs.make(self.env)
        params = task.params if self.params is None else self.params
        belief = task.beliefs[task.default_belief] if self.belief is None else self.belief
        return Problem(task.environment, params, belief)

    @property
    def steps_per_round(self) -> int:
        """Environment steps in a round."""
        return self.num_envs * self.rollout_length

    @property
    def num_rounds(self) -> int:
        """Rounds in a training; the last one may go past `total_steps`."""
        return self._rounds(self.total_steps)

    @property
    def warmup_rounds(self) -> int:
        """Rounds whose actions are all random."""
        return self._rounds(self.warmup_steps)

    @property
    def unasked_rounds(self) -> int:
        """Rounds before the first query."""
        return self._rounds(self.unasked_steps)

    def _rounds(self, steps: int) -> int:
        return -(-steps // self.steps_per_round)

    @property
    def updates_per_round(self) -> int:
        """SAC updates in a round."""
        return max(1, round(self.steps_per_round * self.updates_per_step))

    @property
    def queries_per_round(self) -> int:
        """Queries asked in each round from the first one on until all are asked; there is room for one if nothing is asked."""
        asking_rounds = max(1, self.num_rounds - self.unasked_rounds)
        return capacity(max(1, -(-self.num_queries // asking_rounds)))

    @property
    def room(self) -> int:
        """Rounds that replay and preferences have room for."""
        return capacity(self.num_rounds)

    @property
    def length_values(self) -> Lengths:
        """`lengths`, or what the sizes say."""
        return self.lengths or Lengths(self.num_rounds, self.warmup_rounds, self.unasked_rounds, self.num_queries)

    def with_room(self) -> Config:
        """The same training, equal in everything static to others of other lengths that fit into the same room."""
        return self.replace(
            total_steps=self.room * self.steps_per_round,
            warmup_steps=0,
            unasked_steps=0,
            num_queries=self.room * self.queries_per_round,
            lengths=jax.tree.map(np.int32, self.length_values),
        )

    def check(self) -> None:
        """Raises ValueError, in one line, for the first field whose value makes no sense. Traced values are not looked at.

        A batch of several trainings, as `grid` makes one, is refused: each training is checked by itself.
        """
        for field in dataclasses.fields(self):
            check_value(field, getattr(self, field.name))
            if field.metadata.get("pytree_node", True):
                check_single(field, getattr(self, field.name))
        _check_problem(self.problem())
        if self.num_queries and self.unasked_rounds >= self.num_rounds:
            raise ValueError(
                f"unasked_steps {self.unasked_steps} leaves no round to ask in: a training has {self.num_rounds} rounds of "
                f"{self.steps_per_round} steps; choose at most {(self.num_rounds - 1) * self.steps_per_round}"
            )
        _check_lengths(self)
        if self.num_envs % self.watched_every:
            raise ValueError(
                f"watched_every {self.watched_every} doesn't divide the environments: "
                f"num_envs is {self.num_envs}; choose a divisor of that"
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


# --- checks -----------------------------------------------------------------------------------------------------------------


def _check_problem(problem: Problem) -> None:
    """Raises ValueError if truth and belief aren't two values of the same parameters."""
    params, belief = problem.params, problem.belief
    true, believed = (jax.tree.structure(tree) for tree in (params, belief))
    if true != believed:
        raise ValueError(f"belief {_kind(belief)} doesn't fit params {_kind(params)}: give both the same fields")
    for (path, one), other in zip(jax.tree_util.tree_leaves_with_path(params), jax.tree.leaves(belief), strict=True):
        if np.shape(one) != np.shape(other):
            raise ValueError(
                f"belief has {jax.tree_util.keystr(path)} of shape {np.shape(other)} and params of {np.shape(one)}: "
                "give both the same shapes, and one training one value"
            )


def _check_lengths(config: Config) -> None:
    """Raises ValueError if there is no room for so many rounds or queries. Traced values are not looked at."""
    known = lambda value: not isinstance(value, jax.core.Tracer)
    lengths = config.length_values
    unasked = int(np.max(lengths.unasked_rounds)) if known(lengths.unasked_rounds) else 0
    asking_rounds = max(0, config.num_rounds - unasked)
    room = {"num_rounds": config.num_rounds, "num_queries": asking_rounds * config.queries_per_round}
    for name, most in room.items():
        value = getattr(lengths, name)
        if known(value) and not np.all((np.asarray(value) >= 0) & (np.asarray(value) <= most)):
            raise ValueError(f"lengths have {name} {shown(value)}: there is room for {most}; choose at most that")


def _kind(tree: Any) -> str:
    return f"of type {type(tree).__name__}"


def grid(config: Config, **leaves: Any) -> Config:
    """A `Config` whose every traced leaf has a leading axis, for `jax.vmap(train)`: `leaves` vary, the others are repeated.

    `leaves` are sequences of one length, for traced fields: `grid(config, seed=[0, 1], lam=[2.0, 2.4])` has two configurations.

    Raises:
      ValueError: a static or unknown field, values that make no sense, or sequences of different lengths.
    """
    fields = {field.name: field for field in dataclasses.fields(config)}
    for name, values in leaves.items():
        if name not in fields:
            raise ValueError(unknown_name("field", name, fields))
        if not fields[name].metadata.get("pytree_node", True):
            raise ValueError(
                f"{name} is static: it changes the program, so its values can't share one; train each by itself"
            )
        if name not in ("params", "belief"):
            _check_sequence(fields[name], values)
    config.check()
    batched = {name: jax.tree.map(jnp.asarray, value) if name in ("params", "belief") else jnp.asarray(value)
               for name, value in leaves.items()}  # fmt: skip
    sizes = {leaf.shape[0] if leaf.ndim else 0 for value in batched.values() for leaf in jax.tree.leaves(value)}
    if len(sizes) != 1 or 0 in sizes:
        raise ValueError(
            f"{', '.join(leaves) or 'leaves'} have lengths {sorted(sizes)}: give all of them one length from 1 on"
        )
    (size,) = sizes
    repeated = jax.tree.map(lambda leaf: jnp.broadcast_to(jnp.asarray(leaf), (size, *jnp.shape(leaf))), config)
    return repeated.replace(**batched)


def _check_sequence(field: dataclasses.Field, values: Any) -> None:
    if np.ndim(values) != 1 and not isinstance(values, jax.core.Tracer):
        raise ValueError(f"{field.name} {shown(values)} is no sequence of values: give one for each run")
    for value in values if isinstance(values, list | tuple) else [values]:
        check_value(field, value)
