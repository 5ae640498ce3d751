"""A round as a value: what differs from one to the next, made in one place."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from peps_jax.settings import ScheduleSettings


class RoundKeys(NamedTuple):
    """Random keys of a round, by purpose; (3,) where one purpose has several uses."""

    act: Array  # (3,)
    ask: Array  # (3,)
    answer: Array  # ()
    learn: Array  # (3,)
    improve: Array  # (3,)


class Round(NamedTuple):
    """One round of a training."""

    index: Array  # () int32, from 0
    keys: RoundKeys
    explores_only: Array  # () bool: every action is random
    position: Array  # () int32, of this round's first transition in replay
    filled: Array  # () int32, transitions in replay when this round's are there
    temperature: Array  # () SAC's own, in reward units
    learning_rate: Array  # () SAC's
    policy_entropy: Array  # () share of Eq. (6)'s weight of the policy entropy


def round_at(index: Array, key: Array, schedule: ScheduleSettings) -> Round:
    """Round `index` of the training whose key is `key`. It depends on nothing else: both halves of a round see the same."""
    position = index * schedule.steps_per_round
    return Round(
        index=index,
        keys=_keys(jax.random.fold_in(key, index)),
        explores_only=index < schedule.warmup_rounds,
        position=position,
        filled=position + schedule.steps_per_round,
        temperature=annealed_temperature(index, schedule),
        # late in a training a full step trades one of two nearly equal ways for the other
        learning_rate=(schedule.learning_rate * faded(index, schedule.fade_share, schedule)).astype(jnp.float32),
        # what the objective pays for noise serves learning; whoever acts by samples in the end pays for it
        policy_entropy=faded(index, schedule.entropy_fade_share, schedule).astype(jnp.float32),
    )


def _keys(key: Array) -> RoundKeys:
    purposes = RoundKeys(*jax.random.split(key, len(RoundKeys._fields)))
    uses = RoundKeys(*jax.vmap(lambda key: jax.random.split(key, 3))(jnp.stack(purposes)))  # compiled once
    return uses._replace(answer=purposes.answer)


def annealed_temperature(index: Array, schedule: ScheduleSettings) -> Array:
    """From `initial_temperature` to `temperature`, geometrically, over `anneal_share` of the rounds."""
    done = jnp.clip(index / jnp.maximum(schedule.anneal_share * schedule.num_rounds, 1.0), 0.0, 1.0)
    first, last = jnp.maximum(schedule.initial_temperature, 1e-6), jnp.maximum(schedule.temperature, 1e-6)
    return jnp.exp((1 - done) * jnp.log(first) + done * jnp.log(last)).astype(jnp.float32)


def faded(index: Array, over: Array, schedule: ScheduleSettings) -> Array:
    """1 at first, then falling linearly to a tenth over the last `over` (a share) of the rounds."""
    left = 1 - index / schedule.num_rounds
    return jnp.clip(left / jnp.maximum(over, 1e-6), 0.1, 1.0)
