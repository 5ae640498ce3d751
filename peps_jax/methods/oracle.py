"""The oracle: PEPS that is told l_H + r_H of every transition, which r-hat can only learn of. It asks nobody.

What PEPS loses to it is lost by learning r-hat; what it loses to a planner, by learning to act. A yardstick, no method: nobody
can be asked for a number after every step.
"""

from __future__ import annotations

import jax
from flax import struct
from jax import Array

from peps_jax.learning import dynamics
from peps_jax.methods import peps
from peps_jax.methods.method import Method, register
from peps_jax.preferences.data import PreferenceSet
from peps_jax.round import Round
from peps_jax.settings import Settings
from peps_jax.trajectory import Transition


@struct.dataclass
class Knowledge:
    """What the oracle learns beside the policy."""

    dynamics: dynamics.DynamicsState  # T_A


def init(key: Array, settings: Settings) -> Knowledge:
    """An untrained T_A."""
    return Knowledge(dynamics=dynamics.init(jax.random.split(key)[0], settings.dynamics))


def learn(
    knowledge: Knowledge, buffer: Transition, preferences: PreferenceSet | None, now: Round, settings: Settings
) -> tuple[Knowledge, dict[str, Array]]:
    """T_A from replay, as PEPS learns it."""
    key, *_ = now.keys.learn
    state, info = dynamics.fit(knowledge.dynamics, buffer, now.filled, key, settings.dynamics)
    return Knowledge(dynamics=state), info


def reward(knowledge: Knowledge, transitions: Transition, settings: Settings) -> Array:
    """Eq. (6) without its policy entropy, with l_H + r_H in r-hat's place."""
    told = transitions.log_belief + transitions.human_reward
    return peps.objective(knowledge.dynamics, transitions, told, settings)


def watching(settings: Settings) -> Settings:
    """Told what the human thinks of every step."""
    return settings.replace(rollout=settings.rollout.watching_all())


ORACLE = register(
    Method(
        name="oracle",
        rewards=(reward,),
        uses_lam=True,
        settings=watching,
        init=init,
        learn=learn,
        entropy_weight=peps.entropy_weight,
    )
)
