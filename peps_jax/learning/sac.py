"""Soft actor-critic (Haarnoja et al. 2018a, b), in reward units times `reward_scale`.

    J(Q)  = E[(Q(s,a) - (r + gamma (1 - terminated) V(s')))^2],    V(s) = E_pi[min_j Q_j(s,a) - alpha l_pi(a|s)]
    J(pi) = E[alpha l_pi(a|s) - min_j Q_j(s,a)]

l_pi = log pi - log uniform: relative to the uniform policy, so that the entropy is at most 0 and never pays for staying alive.
How actions are drawn and valued (a squashed Gaussian, or probabilities of discrete actions) is a `Head`.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from flax import struct
from jax import Array

import peps_envs
from peps_jax.config import Config
from peps_jax.learning.networks import MLP, init_ensemble
from peps_jax.learning.policy_heads import Head, continuous_head, discrete_head
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


def head(environment: peps_envs.Environment) -> Head:
    """The head for the environment's action space."""
    make = discrete_head if isinstance(environment.action_space, peps_envs.Discrete) else continuous_head
    return make(environment.observation_size, environment.action_space.size)


def networks(config: Config) -> tuple[Head, MLP, MLP]:
    """The head, the policy's network and a critic's."""
    environment, _, _ = config.task()
    parts = head(environment)
    return (
        parts,
        MLP(config.hidden_sizes, parts.policy_size, output_scale=0.01),
        MLP(config.hidden_sizes, parts.critic_size),
    )


def init(key: Array, config: Config) -> Agent:
    """An untrained agent; the targets start as the critics."""
    environment, _, _ = config.task()
    key_policy, key_critics = jax.random.split(key)
    parts, policy_network, critic_network = networks(config)
    policy = policy_network.init(key_policy, jnp.zeros(environment.observation_size))
    critics = init_ensemble(critic_network, key_critics, NUM_CRITICS, parts.critic_inputs)
    log_temperature = jnp.log(jnp.maximum(config.temperature * config.reward_scale, 1e-6))
    optimizer = optax.adam(config.learning_rate)
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


def draw_noise(key: Array, shape: tuple[int, ...], config: Config) -> Noise:
    """For minibatches of shape `shape`."""
    parts, _, _ = networks(config)
    return Noise(*(parts.noise(key, shape) for key in jax.random.split(key)))


def acting_policy(agents: tuple[Agent, ...], observation: Array, config: Config) -> Any:
    """The policy that acts: the only agent's own, or the normalised product of several agents' policies."""
    parts, policy_network, _ = networks(config)
    policies = [parts.policy(policy_network.apply(agent.policy, observation)) for agent in agents]
    return policies[0] if len(agents) == 1 else parts.product(jax.tree.map(lambda *each: jnp.stack(each), *policies))


def act(agents: tuple[Agent, ...], observation: Array, key: Array, config: Config) -> tuple[Array, Array]:
    """An action sampled from the acting policy, and l_pi(a|s)."""
    parts, _, _ = networks(config)
    return parts.sample(acting_policy(agents, observation, config), parts.noise(key, observation.shape[:-1]))


def mode(agents: tuple[Agent, ...], observation: Array, config: Config) -> tuple[Array, Array]:
    """The acting policy's most likely action before squashing, and l_pi(a|s)."""
    parts, _, _ = networks(config)
    return parts.mode(acting_policy(agents, observation, config))


def critic_loss(critics: Any, targets: Array, batch: Transition, config: Config) -> Array:
    """Half the squared temporal difference, summed over critics and averaged over the batch."""
    parts, _, critic_network = networks(config)
    values = parts.critics(critic_network, critics, batch.observation, batch.action)
    return 0.5 * jnp.sum(jnp.mean((values - targets[None]) ** 2, -1))


def critic_targets(agent: Agent, batch: Transition, temperature: Array, noise: Array, config: Config) -> Array:
    """r + gamma (1 - terminated) V(s') by the target critics: bootstraps through a time limit, not through an end."""
    parts, policy_network, critic_network = networks(config)
    policy = parts.policy(policy_network.apply(agent.policy, batch.next_observation))
    value, ratio = parts.expect(policy, noise, critic_network, agent.targets, batch.next_observation)
    return batch.reward + config.gamma * (1 - batch.terminated) * (value - temperature * ratio)


def policy_loss(
    policy: Any, critics: Any, batch: Transition, temperature: Array, noise: Array, config: Config
) -> tuple[Array, Array]:
    """E[alpha l_pi - min Q], and the mean policy entropy relative to the uniform policy."""
    parts, policy_network, critic_network = networks(config)
    acting = parts.policy(policy_network.apply(policy, batch.observation))
    value, ratio = parts.expect(acting, noise, critic_network, critics, batch.observation)
    penalty = config.saturation_penalty * config.reward_scale * parts.penalty(acting)
    return jnp.mean(temperature * ratio - value) + penalty, -jnp.mean(ratio)


def target_entropy(environment: peps_envs.Environment) -> float:
    """What a tuned temperature aims at, relative to the uniform policy: -n of Haarnoja et al. (2018b) less log 2^n."""
    space = environment.action_space
    if isinstance(space, peps_envs.Discrete):
        return -0.5 * math.log(space.size)
    return -space.size * (1 + math.log(2.0))


def update(
    agent: Agent, batch: Transition, temperature: Array, noise: Noise, config: Config
) -> tuple[Agent, dict[str, Array]]:
    """One step on critics, policy, targets and, if it is tuned, temperature; `batch.reward` in scaled units."""
    optimizer = optax.adam(config.learning_rate)
    alpha = jnp.exp(agent.log_temperature) if config.tune_temperature else temperature

    targets = critic_targets(agent, batch, alpha, noise.targets, config)
    critic_error, critic_grads = jax.value_and_grad(critic_loss)(agent.critics, targets, batch, config)
    critic_steps, critic_optimizer = optimizer.update(critic_grads, agent.critic_optimizer)
    critics = optax.apply_updates(agent.critics, critic_steps)

    (_, entropy), policy_grads = jax.value_and_grad(policy_loss, has_aux=True)(
        agent.policy, critics, batch, alpha, noise.policy, config
    )
    policy_steps, policy_optimizer = optimizer.update(policy_grads, agent.policy_optimizer)
    agent = agent.replace(
        policy=optax.apply_updates(agent.policy, policy_steps),
        critics=critics,
        targets=optax.incremental_update(critics, agent.targets, config.target_rate),
        policy_optimizer=policy_optimizer,
        critic_optimizer=critic_optimizer,
    )
    if config.tune_temperature:
        agent = _tune(agent, entropy, config)
    return agent, {"critic_loss": critic_error, "policy_entropy": entropy, "temperature": alpha}


def _tune(agent: Agent, entropy: Array, config: Config) -> Agent:
    """Moves the temperature up where the entropy is below its target (Haarnoja et al. 2018b, Eq. 18)."""
    environment, _, _ = config.task()
    gradient = entropy - target_entropy(environment)
    step, optimizer = optax.adam(config.learning_rate).update(gradient, agent.temperature_optimizer)
    return agent.replace(log_temperature=agent.log_temperature + step, temperature_optimizer=optimizer)
