"""How actions are drawn and valued: the squashed Gaussian of continuous actions, and probabilities of discrete ones.

Log-densities of a policy's own actions are computed before the squashing, where they are exact however saturated the action is;
only for an action from elsewhere the squashing is inverted.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

import chex
import jax
import jax.numpy as jnp
from jax import Array

from peps_jax.learning.networks import MLP, apply_ensemble

if TYPE_CHECKING:
    import distrax

MIN_LOG_SD, MAX_LOG_SD = -5.0, 2.0


class Gaussian(NamedTuple):
    """A policy before tanh."""

    mean: Array  # (..., action_size)
    log_sd: Array  # (..., action_size)


class Head(NamedTuple):
    """How actions are drawn and valued. A policy is a `Gaussian`, or logits (..., num_actions) of discrete actions.

    Whatever is random comes as `noise`, so that all of a round's is drawn at once: a draw in each update takes a tenth of its time.
    """

    policy_size: int  # of the policy network's outputs
    critic_inputs: int
    critic_size: int
    policy: Callable[[Array], Any]  # outputs of the policy network -> policy
    noise: Callable[[Array, tuple[int, ...]], Array]  # (key, shape) -> of so many actions, (*shape, ...)
    sample: Callable[[Any, Array], tuple[Array, Array]]  # (policy, noise) -> action, l_pi
    mode: Callable[[Any], tuple[Array, Array]]  # policy -> action, l_pi
    log_ratio: Callable[[Any, Array], Array]  # (policy, action from elsewhere) -> l_pi
    product: Callable[[Any], Any]  # several policies, stacked -> their normalised product
    critics: Callable[[Any, Any, Array, Array], Array]  # (network, params, observation, action) -> (critics, ...)
    # (stacked policies, key, shape, number) -> so many actions of each policy and of the uniform one, (candidates, *shape, ...),
    # and the log-density of being proposed, relative to the uniform policy (candidates, *shape)
    propose: Callable[[Any, Array, tuple[int, ...], int], tuple[Array, Array]]
    penalty: Callable[[Any], Array]  # policy -> what keeps it where gradients reach it, at least 0
    # (policy, noise, network, params, observation) -> E_pi[min Q], E_pi[l_pi]
    expect: Callable[[Any, Array, Any, Any, Array], tuple[Array, Array]]


def gaussian(outputs: Array) -> Gaussian:
    """The policy that a network's outputs (..., 2n) stand for: log standard deviations are kept within bounds."""
    mean, raw = jnp.split(outputs, 2, axis=-1)
    return Gaussian(mean, MIN_LOG_SD + 0.5 * (MAX_LOG_SD - MIN_LOG_SD) * (jnp.tanh(raw) + 1))


def squashed(policy: Gaussian) -> distrax.Distribution:
    """tanh of a Gaussian: a distribution of actions in (-1, 1)^n."""
    import distrax  # takes half a second, which who doesn't train needn't wait

    normal = distrax.MultivariateNormalDiag(policy.mean, jnp.exp(policy.log_sd))
    return distrax.Transformed(normal, distrax.Block(distrax.Tanh(), 1))


def log_density(policy: Gaussian, standardized: Array, before: Array) -> Array:
    """log of the squashed density at tanh(before), where before = mean + sd * standardized: exact for saturated actions too.

    log N(before) - sum_i log(1 - tanh(before_i)^2), the latter as 2 (log 2 - x - softplus(-2 x)).
    """
    normal = -0.5 * standardized**2 - policy.log_sd - 0.5 * math.log(2 * math.pi)
    log_slope = 2 * (math.log(2.0) - before - jax.nn.softplus(-2 * before))
    return jnp.sum(normal - log_slope, -1)


def product_of_gaussians(policies: Gaussian) -> Gaussian:
    """The normalised product of Gaussians, stacked along the first axis: means weighed by precisions, which add up.

    Before tanh: the product of squashed densities would count tanh's Jacobian once for each.
    """
    chex.assert_equal_shape([policies.mean, policies.log_sd])
    # relative to the narrowest, so that no precision overflows
    narrowest = jnp.min(policies.log_sd, 0)
    weight = jnp.exp(2 * (narrowest[None] - policies.log_sd))
    total = jnp.sum(weight, 0)
    return Gaussian(jnp.sum(weight * policies.mean, 0) / total, narrowest - 0.5 * jnp.log(total))


def continuous_head(observation_size: int, action_size: int) -> Head:
    """A tanh-squashed Gaussian; expectations are taken with one sample, through which gradients flow."""
    log_volume = action_size * math.log(2.0)  # of [-1, 1]^n

    def sample(policy: Gaussian, noise: Array) -> tuple[Array, Array]:
        before = policy.mean + jnp.exp(policy.log_sd) * noise
        return jnp.tanh(before), log_density(policy, noise, before) + log_volume

    def log_ratio(policy: Gaussian, action: Array) -> Array:
        # the inverse of tanh is infinite at 1
        limit = 1 - 1e-6
        return squashed(policy).log_prob(jnp.clip(action, -limit, limit)) + log_volume

    def propose(policies: Gaussian, key: Array, shape: tuple[int, ...], number: int) -> tuple[Array, Array]:
        key_normal, key_uniform = jax.random.split(key)
        agents = policies.mean.shape[0]
        normal = jax.random.normal(key_normal, (number, agents, *shape, action_size), jnp.float32)
        drawn = jax.vmap(lambda noise: sample(policies, noise)[0])(normal)
        drawn = drawn.reshape(number * agents, *shape, action_size)
        uniform = jax.random.uniform(key_uniform, (number, *shape, action_size), jnp.float32, minval=-1.0, maxval=1.0)
        action = jnp.concatenate([drawn, uniform])
        density = jax.vmap(lambda one: jax.vmap(lambda policy: log_ratio(policy, one))(policies))(action)
        with_uniform = jnp.concatenate([density, jnp.zeros_like(density[:, :1])], 1)
        return action, jax.scipy.special.logsumexp(with_uniform, 1) - math.log(agents + 1)

    def critics(network: MLP, params: Any, observation: Array, action: Array) -> Array:
        return apply_ensemble(network)(params, jnp.concatenate([observation, action], -1))[..., 0]

    def expect(policy: Gaussian, noise: Array, network: MLP, params: Any, observation: Array) -> tuple[Array, Array]:
        action, ratio = sample(policy, noise)
        return jnp.min(critics(network, params, observation, action), 0), ratio

    return Head(
        policy_size=2 * action_size,
        critic_inputs=observation_size + action_size,
        critic_size=1,
        policy=gaussian,
        noise=lambda key, shape: jax.random.normal(key, (*shape, action_size), jnp.float32),
        sample=sample,
        mode=lambda policy: sample(policy, jnp.zeros_like(policy.mean)),
        log_ratio=log_ratio,
        product=product_of_gaussians,
        propose=propose,
        critics=critics,
        # where tanh is flat no gradient turns an action back: a policy that leans against a wall would stay there
        penalty=lambda policy: jnp.mean(jnp.sum(policy.mean**2, -1)),
        expect=expect,
    )


def discrete_head(observation_size: int, num_actions: int) -> Head:
    """Probabilities of discrete actions; critics value all of them at once, so expectations are exact sums."""
    log_actions = math.log(num_actions)

    def log_ratio(logits: Array, action: Array) -> Array:
        return jnp.take_along_axis(jax.nn.log_softmax(logits), action[..., None], -1)[..., 0] + log_actions

    def sample(logits: Array, noise: Array) -> tuple[Array, Array]:
        action = jnp.argmax(logits + noise, -1).astype(jnp.int32)  # the Gumbel-max trick
        return action, log_ratio(logits, action)

    def propose(policies: Array, key: Array, shape: tuple[int, ...], number: int) -> tuple[Array, Array]:
        del policies, key, number
        action = jnp.arange(num_actions, dtype=jnp.int32).reshape(-1, *(1,) * len(shape))
        return jnp.broadcast_to(action, (num_actions, *shape)), jnp.zeros((num_actions, *shape), jnp.float32)

    def critics(network: MLP, params: Any, observation: Array, action: Array) -> Array:
        values = apply_ensemble(network)(params, observation)
        return jnp.take_along_axis(values, jnp.broadcast_to(action, values.shape[:-1])[..., None], -1)[..., 0]

    def expect(logits: Array, noise: Array, network: MLP, params: Any, observation: Array) -> tuple[Array, Array]:
        del noise
        probabilities, log_probabilities = jax.nn.softmax(logits), jax.nn.log_softmax(logits)
        values = jnp.min(apply_ensemble(network)(params, observation), 0)
        return jnp.sum(probabilities * values, -1), jnp.sum(probabilities * log_probabilities, -1) + log_actions

    return Head(
        policy_size=num_actions,
        critic_inputs=observation_size,
        critic_size=num_actions,
        policy=lambda outputs: outputs,
        noise=lambda key, shape: jax.random.gumbel(key, (*shape, num_actions), jnp.float32),
        sample=sample,
        mode=lambda logits: sample(logits, jnp.zeros_like(logits)),
        log_ratio=log_ratio,
        product=lambda logits: jnp.sum(jax.nn.log_softmax(logits), 0),
        propose=propose,  # all of them, once
        critics=critics,
        penalty=lambda logits: jnp.zeros((), jnp.float32),
        expect=expect,
    )
