"""What each part of a training is told: a record of its own settings, made once from the flat `Config`.

No part sees the whole configuration, and nothing looks the problem up again. What a record holds of an environment are its
spaces: a network's shapes follow from them.
"""

from __future__ import annotations

import math
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jax import Array

import peps_envs
from peps_jax.config import Config, Problem

_static = lambda **default: struct.field(pytree_node=False, **default)
_whole = lambda: struct.field(metadata={"whole": True})


@struct.dataclass
class ObjectiveSettings:
    """Weights of Eq. (6)."""

    lam: Array
    surrogate_weight: Array
    environment_entropy_weight: Array
    policy_entropy_weight: Array
    # per step, what Eq. (6)'s entropies are more than relative ones, each at its weight; 0 where they are meant to be relative
    entropy_offset: Array


@struct.dataclass
class ScheduleSettings:
    """How a training is divided into rounds, and what changes from round to round."""

    room: int = _static()  # rounds that replay has room for
    steps_per_round: int = _static()  # of all environments
    num_rounds: Array = _whole()
    warmup_rounds: Array = _whole()
    learning_rate: Array
    fade_share: Array
    entropy_fade_share: Array
    initial_temperature: Array
    temperature: Array
    anneal_share: Array


@struct.dataclass
class RolloutSettings:
    """How experience is collected."""

    num_envs: int = _static()
    length: int = _static()  # steps of each environment in a round
    hold_steps: int = _static()  # for which a random action is held
    exploration: Array  # share of the steps with random actions
    watched_every: int = _static(default=1)  # of how many environments the human watches one
    imagines: bool = _static(default=False)  # whether what the human imagines is kept, for a method that learns from it

    @property
    def watched_envs(self) -> int:
        """Environments that the human watches, the first ones."""
        return self.num_envs // self.watched_every

    def watching_all(self) -> RolloutSettings:
        """For a method that is told what the human thinks of every step."""
        return self.replace(watched_every=1)


@struct.dataclass
class AgentSettings:
    """Soft actor-critic's."""

    observation_size: int = _static()
    action_space: peps_envs.ActionSpace = _static()
    hidden_sizes: tuple[int, ...] = _static()
    batch_size: int = _static()  # transitions
    updates: int = _static()  # in a round
    critic_normalisation: bool = _static()  # of hidden layers, by their root mean square
    product: str = _static()  # how several agents act together, one of `config.PRODUCTS`
    tune_temperature: bool = _static()
    gamma: Array
    learning_rate: Array
    temperature: Array  # reward units, at which tuning starts
    target_rate: Array
    reward_scale: Array
    saturation_penalty: Array  # reward units


@struct.dataclass
class DynamicsSettings:
    """The learned dynamics', T_A."""

    observation_size: int = _static()
    action_space: peps_envs.ActionSpace = _static()
    perceived_size: int = _static()
    ensemble_size: int = _static()
    hidden_sizes: tuple[int, ...] = _static()
    updates: int = _static()  # in a round
    batch_size: int = _static()  # transitions
    learning_rate: Array


@struct.dataclass
class SurrogateSettings:
    """The surrogate reward's, r-hat."""

    observation_size: int = _static()
    action_space: peps_envs.ActionSpace = _static()
    ensemble_size: int = _static()
    hidden_sizes: tuple[int, ...] = _static()
    updates: int = _static()  # in a round
    batch_size: int = _static()  # preferences
    prior: str = _static()  # what r-hat is learned as a difference from, one of `config.PRIORS`
    bound: float = _static()  # most that it may be above that, in reward units
    level: str = _static()  # what pins r-hat's level, one of `config.LEVELS`
    uniform_answers: float = (
        _static()
    )  # probability, assumed in the likelihood, that the human answers uniformly at random
    validates: bool = _static()  # whether weight decay follows the loss on what a member's resample left out
    learning_rate: Array
    decay: Array


@struct.dataclass
class QuerySettings:
    """How queries are made and chosen."""

    per_round: int = _static()
    room: int = _static()  # places that all rounds' queries take
    unasked_rounds: Array = _whole()  # before the first query
    budget: Array = _whole()  # in all; the last round may have fewer than others
    segment_length: int = _static()  # steps
    min_segment_length: int = _static()
    strategy: str = _static()
    candidates_per_query: int = _static()


@struct.dataclass
class HumanSettings:
    """How the synthetic human answers; see `peps_jax.preferences.synthetic_human`."""

    rationality: Array
    myopia: Array
    informed: Array
    mistake_rate: Array
    indifference: Array
    skip_below: Array


@struct.dataclass
class Settings:
    """Every part's record."""

    objective: ObjectiveSettings
    schedule: ScheduleSettings
    rollout: RolloutSettings
    agent: AgentSettings
    dynamics: DynamicsSettings
    surrogate: SurrogateSettings
    queries: QuerySettings
    human: HumanSettings


def settings_of(config: Config, problem: Problem) -> Settings:
    """`config`, divided among the parts."""
    environment = problem.environment
    spaces = dict(observation_size=environment.observation_size, action_space=environment.action_space)
    models = dict(ensemble_size=config.ensemble_size, hidden_sizes=config.model_hidden_sizes)
    lengths = config.length_values
    return Settings(
        objective=_record(ObjectiveSettings, config, entropy_offset=_entropy_offset(config, problem)),
        schedule=_record(ScheduleSettings, config, num_rounds=lengths.num_rounds, warmup_rounds=lengths.warmup_rounds),
        rollout=_record(RolloutSettings, config, length=config.rollout_length, imagines=False),
        agent=_record(AgentSettings, config, updates=config.updates_per_round, **spaces),
        dynamics=_record(
            DynamicsSettings,
            config,
            perceived_size=_perceived_size(problem),
            updates=config.dynamics_updates,
            batch_size=config.dynamics_batch_size,
            learning_rate=config.dynamics_learning_rate,
            **spaces,
            **models,
        ),
        surrogate=_record(
            SurrogateSettings,
            config,
            updates=config.surrogate_updates,
            batch_size=config.surrogate_batch_size,
            validates=False,
            learning_rate=config.surrogate_learning_rate,
            decay=config.surrogate_decay,
            **spaces,
            **models,
        ),
        queries=_record(
            QuerySettings,
            config,
            per_round=config.queries_per_round,
            room=config.room * config.queries_per_round,
            unasked_rounds=lengths.unasked_rounds,
            budget=lengths.num_queries,
            strategy=config.query_strategy,
        ),
        human=_record(HumanSettings, config),
    )


def _record(kind: type, config: Config, **values: Any) -> Any:
    """A record of `kind`: fields that are called as in `config` have its values. Traced ones are 32-bit floats, or whole numbers.

    The library's own numbers are 32-bit whatever JAX's default is: networks learn no better from more.
    """
    found = {}
    for name, field in kind.__dataclass_fields__.items():
        value = values[name] if name in values else getattr(config, name)
        number = jnp.int32 if field.metadata.get("whole") else jnp.float32
        found[name] = jnp.asarray(value, number) if field.metadata.get("pytree_node", True) else value
    return kind(**found)


def _perceived_size(problem: Problem) -> int:
    """How many numbers people perceive of a state."""
    return jax.eval_shape(problem.environment.perception_width, problem.params).shape[0]


def _entropy_offset(config: Config, problem: Problem) -> Array | float:
    """What Eq. (6)'s entropies as they are defined are more per step than those against kernel and uniform policy.

    H of the kernel, n/2 log(2 pi e) + sum_i log sigma_p,i, and H of the uniform policy. It keeps the policy entropy's whole
    weight to the end: what a step pays stays as it is, only noise gets cheaper to leave out.
    """
    if config.entropies == "relative":
        return 0.0
    width = problem.environment.perception_width(problem.params)
    kernel = 0.5 * width.shape[0] * math.log(2 * math.pi * math.e) + jnp.sum(jnp.log(width))
    uniform = problem.environment.action_space.uniform_entropy
    return config.environment_entropy_weight * kernel + config.policy_entropy_weight * uniform
