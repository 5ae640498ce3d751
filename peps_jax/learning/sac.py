"""Soft actor-critic (Haarnoja et al. 2018a, b), in reward units times `reward_scale`.

    J(Q)  = E[(Q(s,a) - (r + gamma (1 - terminated) V(s')))^2],    V(s) = E_pi[min_j Q_j(s,a) - alpha l_pi(a|s)]
    J(pi) = E[alpha l_pi(a|s) - min_j Q_j(s,a)]

l_pi = log pi - log uniform: relative to the uniform policy, so that the entropy is at most 0 and never pays for staying alive.
How actions are drawn and valued (a squashed Gaussian, or probabilities of discrete actions) is a `Head`.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import chex
import jax
import jax.numpy as jnp
import optax
from flax import struct
from jax import Array

import peps_envs
from peps_jax.learning.networks import MLP, init_ensemble
from peps_jax.learning.policy_heads import Head, continuous_head, discrete_head
from peps_jax.settings import AgentSettings
from peps_jax.trajectory import Transition

NUM_CRITICS = 2


@struct.dataclass
class Agent:
    """Everything that SAC learns."""

    policy: Any
    critics: Any  # leading axis: critics
    targets: Any  # the critics' slow copies
    log_temperature: Array  # () of the tuned temperature, in scaled units
    policy_optimizer: Any
    critic_optimizer: Any
    temperature_optimizer: Any


def head_of(settings: AgentSettings) -> Head:
    """The head for the action space."""
    make = discrete_head if isinstance(settings.action_space, peps_envs.Discrete) else continuous_head
    return make(settings.observation_size, settings.action_space.size)


def networks(settings: AgentSettings) -> tuple[Head, MLP, MLP]:
    """The head, the policy's network and a critic's."""
    head = head_of(settings)
    return (
        head,
        MLP(settings.hidden_sizes, head.policy_size, output_scale=0.01),
        MLP(settings.hidden_sizes, head.critic_size, normalised=settings.critic_normalisation),
    )


def init(key: Array, settings: AgentSettings) -> Agent:
    """An untrained agent; the targets start as the critics."""
    key_policy, key_critics = jax.random.split(key)
    head, policy_network, critic_network = networks(settings)
    policy = policy_network.init(key_policy, jnp.zeros(settings.observation_size, jnp.float32))
    critics = init_ensemble(critic_network, key_critics, NUM_CRITICS, head.critic_inputs)
    log_temperature = jnp.log(jnp.maximum(settings.temperature * settings.reward_scale, 1e-6))
    optimizer = optax.adam(settings.learning_rate)
    return Agent(
        policy=policy,
        critics=critics,
        targets=critics,
        log_temperature=log_temperature,
        policy_optimizer=optimizer.init(policy),
        critic_optimizer=optimizer.init(critics),
        temperature_optimizer=optimizer.init(log_temperature),
    )


class Noise(NamedTuple):
    """What `update` draws its actions with: for a minibatch, or for many along leading axes."""

    targets: Array  # at s'
    policy: Array  # at s


def draw_noise(key: Array, shape: tuple[int, ...], settings: AgentSettings) -> Noise:
    """For minibatches of shape `shape`."""
    drawn = jax.vmap(lambda key: head_of(settings).noise(key, shape))(jax.random.split(key))  # compiled once
    return Noise(*drawn)


def agent_keys(key: Array, number: int) -> list[Array]:
    """A key for each of `number` agents. The first one's is `key` itself: others don't change its numbers."""
    return [key, *(jax.random.fold_in(key, other) for other in range(1, number))]


def critic_loss(critics: Any, targets: Array, batch: Transition, settings: AgentSettings) -> Array:
    """Half the squared temporal difference, summed over critics and averaged over the batch."""
    head, _, critic_network = networks(settings)
    values = head.critics(critic_network, critics, batch.observation, batch.action)
    return 0.5 * jnp.sum(jnp.mean((values - targets[None]) ** 2, -1))


def next_value(agent: Agent, batch: Transition, temperature: Array, noise: Array, settings: AgentSettings) -> Array:
    """V(s') of the agent's own policy by the target critics."""
    head, policy_network, critic_network = networks(settings)
    policy = head.policy(policy_network.apply(agent.policy, batch.next_observation))
    value, ratio = head.expect(policy, noise, critic_network, agent.targets, batch.next_observation)
    return value - temperature * ratio


def critic_targets(batch: Transition, value: Array, settings: AgentSettings) -> Array:
    """r + gamma (1 - terminated) V(s'): bootstraps through a time limit, not through an end."""
    return batch.reward + settings.gamma * jnp.where(batch.terminated, 0.0, 1.0) * value


def policy_loss(
    policy: Any, critics: Any, batch: Transition, temperature: Array, noise: Array, settings: AgentSettings
) -> tuple[Array, Array]:
    """E[alpha l_pi - min Q], and the mean policy entropy relative to the uniform policy."""
    head, policy_network, critic_network = networks(settings)
    acting = head.policy(policy_network.apply(policy, batch.observation))
    value, ratio = head.expect(acting, noise, critic_network, critics, batch.observation)
    penalty = settings.saturation_penalty * settings.reward_scale * head.penalty(acting)
    return jnp.mean(temperature * ratio - value) + penalty, -jnp.mean(ratio)


def target_entropy(space: peps_envs.ActionSpace) -> float:
    """What a tuned temperature aims at, relative to the uniform policy: -n of Haarnoja et al. (2018b) less log 2^n."""
    if isinstance(space, peps_envs.Discrete):
        return -0.5 * math.log(space.size)
    return -space.size * (1 + math.log(2.0))


def update(
    agent: Agent,
    batch: Transition,
    temperature: Array,
    noise: Noise,
    settings: AgentSettings,
    value: Array | None = None,
) -> tuple[Agent, dict[str, Array]]:
    """One step on critics, policy, targets and, if it is tuned, temperature; `batch.reward` in scaled units.

    `value` is V(s') where something else than the agent's own policy acts.
    """
    chex.assert_equal_shape_prefix([batch.observation, batch.action, batch.next_observation], 1)
    chex.assert_equal_shape([batch.reward, batch.terminated])
    optimizer = optax.adam(settings.learning_rate)
    alpha = jnp.exp(agent.log_temperature) if settings.tune_temperature else temperature

    if value is None:
        value = next_value(agent, batch, alpha, noise.targets, settings)
    targets = critic_targets(batch, value, settings)
    critic_error, critic_grads = jax.value_and_grad(critic_loss)(agent.critics, targets, batch, settings)
    critic_steps, critic_optimizer = optimizer.update(critic_grads, agent.critic_optimizer)
    critics = optax.apply_updates(agent.critics, critic_steps)

    (_, entropy), policy_grads = jax.value_and_grad(policy_loss, has_aux=True)(
        agent.policy, critics, batch, alpha, noise.policy, settings
    )
    policy_steps, policy_optimizer = optimizer.update(policy_grads, agent.policy_optimizer)
    agent = agent.replace(
        policy=optax.apply_updates(agent.policy, policy_steps),
        critics=critics,
        targets=optax.incremental_update(critics, agent.targets, settings.target_rate),
        policy_optimizer=policy_optimizer,
        critic_optimizer=critic_optimizer,
    )
    if settings.tune_temperature:
        agent = _tune(agent, entropy, settings)
    return agent, {"critic_loss": critic_error, "policy_entropy": entropy, "temperature": alpha}


def _tune(agent: Agent, entropy: Array, settings: AgentSettings) -> Agent:
    """Moves the temperature up where the entropy is below its target (Haarnoja et al. 2018b, Eq. 18)."""
    gradient = entropy - target_entropy(settings.action_space)
    step, optimizer = optax.adam(settings.learning_rate).update(gradient, agent.temperature_optimizer)
    return agent.replace(log_temperature=agent.log_temperature + step, temperature_optimizer=optimizer)
