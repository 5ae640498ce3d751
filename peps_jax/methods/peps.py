"""PEPS, the paper's method: SAC on r_A + lambda (r_hat + H_T + H_pi), Eq. (6), with T_A and r_hat learned on the way."""

from __future__ import annotations

import chex
import jax
from flax import struct
from jax import Array

from peps_jax.learning import dynamics, surrogate
from peps_jax.methods import preference_based
from peps_jax.methods.method import register
from peps_jax.methods.preference_based import PREFERENCE_BASED
from peps_jax.preferences.data import PreferenceSet
from peps_jax.round import Round
from peps_jax.settings import Settings
from peps_jax.trajectory import Transition


@struct.dataclass
class Knowledge:
    """What PEPS learns beside the policy."""

    dynamics: dynamics.DynamicsState  # T_A
    surrogate: surrogate.SurrogateState  # r_hat


def init(key: Array, settings: Settings) -> Knowledge:
    """Untrained T_A and r-hat."""
    key_dynamics, key_surrogate = jax.random.split(key)
    return Knowledge(
        dynamics=dynamics.init(key_dynamics, settings.dynamics),
        surrogate=surrogate.init(key_surrogate, settings.surrogate),
    )


def learn(
    knowledge: Knowledge, buffer: Transition, preferences: PreferenceSet, now: Round, settings: Settings
) -> tuple[Knowledge, dict[str, Array]]:
    """Lines 4-8 of Algorithm 1: T_A from replay, r_hat from the preferences given so far."""
    key_dynamics, _, key_surrogate = now.keys.learn
    dynamics_state, dynamics_info = dynamics.fit(
        knowledge.dynamics, buffer, now.filled, key_dynamics, settings.dynamics
    )
    surrogate_state, surrogate_info = preference_based.fit_surrogate(
        knowledge.surrogate, buffer, preferences, now.filled, key_surrogate, settings
    )
    return Knowledge(dynamics=dynamics_state, surrogate=surrogate_state), dynamics_info | surrogate_info


def objective(
    dynamics_state: dynamics.DynamicsState, transitions: Transition, preferred: Array, settings: Settings
) -> Array:
    """Eq. (6) without its policy entropy, which is SAC's own: r_A + lambda (preferred + H_T), r-hat being `preferred` (...)."""
    weights = settings.objective
    entropy = dynamics.environment_entropy(
        dynamics_state, transitions.observation, transitions.action, settings.dynamics
    )
    chex.assert_equal_shape([transitions.reward, preferred, entropy])
    explicable = (
        weights.surrogate_weight * preferred + weights.environment_entropy_weight * entropy + weights.entropy_offset
    )
    return transitions.reward + weights.lam * explicable


def reward(knowledge: Knowledge, transitions: Transition, settings: Settings) -> Array:
    """Eq. (6) with r-hat as it is known."""
    preferred = surrogate.predict(
        knowledge.surrogate, transitions.observation, transitions.action, transitions.reward, settings.surrogate
    )
    return objective(knowledge.dynamics, transitions, preferred, settings)


def entropy_weight(settings: Settings) -> Array:
    """Eq. (6)'s weight of the policy entropy. SAC's own temperature explores; this comes on top: at lambda = 0 PEPS is SAC."""
    return settings.objective.lam * settings.objective.policy_entropy_weight


PEPS = register(
    PREFERENCE_BASED._replace(
        name="peps",
        rewards=(reward,),
        uses_lam=True,
        init=init,
        learn=learn,
        entropy_weight=entropy_weight,
    )
)
