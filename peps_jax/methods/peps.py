"""PEPS, the paper's method: SAC on r_A + lambda (r_hat + H_T + H_pi), Eq. (6), with T_A and r_hat learned on the way."""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
from flax import struct
from jax import Array

from peps_jax.config import Config
from peps_jax.learning import dynamics, surrogate
from peps_jax.methods import preference_based
from peps_jax.methods.method import Method, true_world
from peps_jax.trajectory import Preferences, Transition


@struct.dataclass
class Knowledge:
    """What PEPS learns beside the policy."""

    dynamics: dynamics.DynamicsState  # T_A
    surrogate: surrogate.SurrogateState  # r_hat


def init(key: Array, config: Config) -> Knowledge:
    key_dynamics, key_surrogate = jax.random.split(key)
    return Knowledge(dynamics=dynamics.init(key_dynamics, config), surrogate=surrogate.init(key_surrogate, config))


def learn(
    knowledge: Knowledge,
    buffer: Transition,
    filled: Array,
    preferences: Preferences,
    index: Array,
    key: Array,
    config: Config,
) -> tuple[Knowledge, dict[str, Array]]:
    """Lines 4-8 of Algorithm 1: T_A from replay, r_hat from the preferences given so far."""
    key_dynamics, *keys = jax.random.split(key, 3)
    dynamics_state, dynamics_info = dynamics.fit(knowledge.dynamics, buffer, filled, key_dynamics, config)
    surrogate_state, surrogate_info = preference_based.learn(
        knowledge.surrogate, buffer, filled, preferences, index, tuple(keys), config
    )
    return Knowledge(dynamics=dynamics_state, surrogate=surrogate_state), dynamics_info | surrogate_info


def reward(knowledge: Knowledge, transitions: Transition, config: Config) -> Array:
    """Eq. (6) without its policy entropy, which is SAC's own: r_A + lambda (r_hat + H_T)."""
    observation, action = transitions.observation, transitions.action
    preferred = surrogate.predict(knowledge.surrogate, observation, action, config)
    entropy = dynamics.environment_entropy(knowledge.dynamics, observation, action, config)
    explicable = config.surrogate_weight * preferred + config.environment_entropy_weight * entropy
    return transitions.reward + config.lam * explicable


PEPS = Method(
    name="peps",
    uses_lam=True,
    world=true_world,
    init=init,
    ask=lambda knowledge, trajectory, key, config: preference_based.ask(knowledge.surrogate, trajectory, key, config),
    learn=learn,
    rewards=(reward,),
    # SAC's own temperature explores; Eq. (6)'s comes on top, so that at lambda = 0 PEPS is SAC
    entropy_weight=lambda config: config.lam * config.policy_entropy_weight,
)


def absolute_reward(knowledge: Knowledge, transitions: Transition, config: Config) -> Array:
    """`reward` with Eq. (6)'s entropies as they are defined, and not against the perceptual kernel and the uniform policy.

    They are more by a constant per step, H of the kernel, n/2 log(2 pi e) + sum_i log sigma_p,i, and H of the uniform policy.
    """
    environment, params, _ = config.task()
    width = environment.perception_width(params)
    kernel = 0.5 * width.shape[0] * math.log(2 * math.pi * math.e) + jnp.sum(jnp.log(width))
    uniform = environment.action_space.uniform_entropy
    constant = config.environment_entropy_weight * kernel + config.policy_entropy_weight * uniform
    return reward(knowledge, transitions, config) + config.lam * constant


PEPS_ABSOLUTE = PEPS._replace(name="peps_absolute", rewards=(absolute_reward,))  # an ablation
