"""Soft actor-critic (Haarnoja et al. 2018a, b), in reward units times `reward_scale`.

    J(Q)  = E[(Q(s,a) - (r + gamma (1 - terminated) V(s')))^2],    V(s) = E_pi[min_j Q_j(s,a) - alpha l_pi(a|s)]
    J(pi) = E[alpha l_pi(a|s) - min_j Q_j(s,a)]

l_pi = log pi - log uniform: relative to the uniform policy, so that the entropy is at most 0 and never pays for staying alive.
What the policy's head is made of (a squashed Gaussian, or probabilities of discrete actions) is a `Head`.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import distrax
import jax
import jax.numpy as jnp
import optax
from flax import struct
from jax import Array

import peps_envs
from peps_jax.config import Config
from peps_jax.learning.networks import MLP, apply_ensemble, init_ensemble
from peps_jax.trajectory import Transition

MIN_LOG_SD, MAX_LOG_SD = -5.0, 2.0
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


class Head(NamedTuple):
    """How actions are drawn and valued. `outputs` are the policy network's, `critics` a function of (observation, action).

    Whatever is random comes as `noise`, so that all of a round's is drawn at once: a draw in each update takes a tenth of its time.
    """

    policy_size: int
    critic_inputs: int
    critic_size: int
    noise: Callable[[Array, tuple[int, ...]], Array]  # (key, shape) -> of so many actions, (*shape, ...)
    sample: Callable[[Array, Array], tuple[Array, Array]]  # (outputs, noise) -> action, l_pi
    mode: Callable[[Array], Array]  # outputs -> action
    log_ratio: Callable[[Array, Array], Array]  # (outputs, action) -> l_pi
    product: Callable[[Array], Array]  # outputs of several policies, stacked -> those of their normalised product
    uniform: Callable[[Array], Array]  # key -> action
    critics: Callable[[Any, Any, Array, Array], Array]  # (network, params, observation, action) -> (critics, ...)
    penalty: Callable[[Array], Array]  # outputs -> what keeps the policy where gradients reach it, at least 0
    # (outputs, noise, network, params, observation) -> E_pi[min Q], E_pi[l_pi]
    expect: Callable[[Array, Array, Any, Any, Array], tuple[Array, Array]]


def _gaussian(outputs: Array) -> tuple[Array, Array]:
    """Mean and log standard deviation before tanh, from outputs (..., 2n)."""
    mean, log_sd = jnp.split(outputs, 2, axis=-1)
    return mean, MIN_LOG_SD + 0.5 * (MAX_LOG_SD - MIN_LOG_SD) * (jnp.tanh(log_sd) + 1)


def squashed_gaussian(outputs: Array) -> distrax.Distribution:
    """tanh of a Gaussian: actions in (-1, 1)^n from outputs (..., 2n)."""
    mean, log_sd = _gaussian(outputs)
    return distrax.Transformed(distrax.MultivariateNormalDiag(mean, jnp.exp(log_sd)), distrax.Block(distrax.Tanh(), 1))


def continuous_head(observation_size: int, action_size: int) -> Head:
    """A tanh-squashed Gaussian; expectations are taken with one sample, through which gradients flow."""
    log_volume = action_size * math.log(2.0)  # of [-1, 1]^n

    def sample(outputs: Array, noise: Array) -> tuple[Array, Array]:
        density = squashed_gaussian(outputs)
        mean, log_sd = _gaussian(outputs)
        before = mean + jnp.exp(log_sd) * noise
        action, log_slope = density.bijector.forward_and_log_det(before)
        return action, density.distribution.log_prob(before) - log_slope + log_volume

    def log_ratio(outputs: Array, action: Array) -> Array:
        # the inverse of tanh is infinite at 1
        limit = 1 - 1e-6
        return squashed_gaussian(outputs).log_prob(jnp.clip(action, -limit, limit)) + log_volume

    def critics(network: MLP, params: Any, observation: Array, action: Array) -> Array:
        return apply_ensemble(network)(params, jnp.concatenate([observation, action], -1))[..., 0]

    def expect(outputs: Array, noise: Array, network: MLP, params: Any, observation: Array) -> tuple[Array, Array]:
        action, ratio = sample(outputs, noise)
        return jnp.min(critics(network, params, observation, action), 0), ratio

    def product(outputs: Array) -> Array:
        # of the Gaussians before tanh: the product of squashed densities would count tanh's Jacobian once for each
        mean, log_sd = _gaussian(outputs)
        precision = jnp.exp(-2 * log_sd)
        total = jnp.sum(precision, 0)
        share = (-0.5 * jnp.log(total) - MIN_LOG_SD) / (MAX_LOG_SD - MIN_LOG_SD)  # of the way between a head's bounds
        limit = 1 - 1e-6  # the inverse of tanh is infinite at 1
        return jnp.concatenate(
            [jnp.sum(precision * mean, 0) / total, jnp.arctanh(jnp.clip(2 * share - 1, -limit, limit))], -1
        )

    return Head(
        policy_size=2 * action_size,
        critic_inputs=observation_size + action_size,
        critic_size=1,
        noise=lambda key, shape: jax.random.normal(key, (*shape, action_size)),
        sample=sample,
        mode=lambda outputs: jnp.tanh(jnp.split(outputs, 2, axis=-1)[0]),
        log_ratio=log_ratio,
        product=product,
        uniform=lambda key: jax.random.uniform(key, (action_size,), minval=-1.0, maxval=1.0),
        critics=critics,
        # where tanh is flat no gradient turns an action back: a policy that leans against a wall would stay there
        penalty=lambda outputs: jnp.mean(jnp.sum(jnp.split(outputs, 2, axis=-1)[0] ** 2, -1)),
        expect=expect,
    )


def discrete_head(observation_size: int, num_actions: int) -> Head:
    """Probabilities of discrete actions; critics value all of them at once, so expectations are exact sums."""
    log_actions = math.log(num_actions)

    def log_ratio(outputs: Array, action: Array) -> Array:
        return jnp.take_along_axis(jax.nn.log_softmax(outputs), action[..., None], -1)[..., 0] + log_actions

    def sample(outputs: Array, noise: Array) -> tuple[Array, Array]:
        action = jnp.argmax(outputs + noise, -1)  # the Gumbel-max trick
        return action, log_ratio(outputs, action)

    def critics(network: MLP, params: Any, observation: Array, action: Array) -> Array:
        values = apply_ensemble(network)(params, observation)
        return jnp.take_along_axis(values, jnp.broadcast_to(action, values.shape[:-1])[..., None], -1)[..., 0]

    def expect(outputs: Array, noise: Array, network: MLP, params: Any, observation: Array) -> tuple[Array, Array]:
        del noise
        probabilities, log_probabilities = jax.nn.softmax(outputs), jax.nn.log_softmax(outputs)
        values = jnp.min(apply_ensemble(network)(params, observation), 0)
        return jnp.sum(probabilities * values, -1), jnp.sum(probabilities * log_probabilities, -1) + log_actions

    return Head(
        policy_size=num_actions,
        critic_inputs=observation_size,
        critic_size=num_actions,
        noise=lambda key, shape: jax.random.gumbel(key, (*shape, num_actions)),
        sample=sample,
        mode=lambda outputs: jnp.argmax(outputs, -1),
        log_ratio=log_ratio,
        product=lambda outputs: jnp.sum(jax.nn.log_softmax(outputs), 0),
        uniform=lambda key: jax.random.randint(key, (), 0, num_actions),
        critics=critics,
        penalty=lambda outputs: jnp.zeros(()),
        expect=expect,
    )


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


def acting_outputs(agents: tuple[Agent, ...], observation: Array, config: Config) -> Array:
    """Outputs of the acting policy: the only agent's own, or those of the normalised product of several agents' policies."""
    parts, policy_network, _ = networks(config)
    outputs = [policy_network.apply(agent.policy, observation) for agent in agents]
    return outputs[0] if len(agents) == 1 else parts.product(jnp.stack(outputs))


def act(agents: tuple[Agent, ...], observation: Array, key: Array, config: Config) -> tuple[Array, Array]:
    """An action sampled from the acting policy, and l_pi(a|s)."""
    parts, _, _ = networks(config)
    return parts.sample(acting_outputs(agents, observation, config), parts.noise(key, observation.shape[:-1]))


def mode(agents: tuple[Agent, ...], observation: Array, config: Config) -> tuple[Array, Array]:
    """The acting policy's most likely action before squashing, and l_pi(a|s)."""
    parts, _, _ = networks(config)
    outputs = acting_outputs(agents, observation, config)
    action = parts.mode(outputs)
    return action, parts.log_ratio(outputs, action)


def critic_loss(critics: Any, targets: Array, batch: Transition, config: Config) -> Array:
    """Half the squared temporal difference, summed over critics and averaged over the batch."""
    parts, _, critic_network = networks(config)
    values = parts.critics(critic_network, critics, batch.observation, batch.action)
    return 0.5 * jnp.sum(jnp.mean((values - targets[None]) ** 2, -1))


def critic_targets(agent: Agent, batch: Transition, temperature: Array, noise: Array, config: Config) -> Array:
    """r + gamma (1 - terminated) V(s') by the target critics: bootstraps through a time limit, not through an end."""
    parts, policy_network, critic_network = networks(config)
    outputs = policy_network.apply(agent.policy, batch.next_observation)
    value, ratio = parts.expect(outputs, noise, critic_network, agent.targets, batch.next_observation)
    return batch.reward + config.gamma * (1 - batch.terminated) * (value - temperature * ratio)


def policy_loss(
    policy: Any, critics: Any, batch: Transition, temperature: Array, noise: Array, config: Config
) -> tuple[Array, Array]:
    """E[alpha l_pi - min Q], and the mean policy entropy relative to the uniform policy."""
    parts, policy_network, critic_network = networks(config)
    outputs = policy_network.apply(policy, batch.observation)
    value, ratio = parts.expect(outputs, noise, critic_network, critics, batch.observation)
    penalty = config.saturation_penalty * config.reward_scale * parts.penalty(outputs)
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
