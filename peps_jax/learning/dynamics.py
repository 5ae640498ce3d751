"""The learned dynamics T_A: an ensemble of Gaussian networks, fitted to replay by maximum likelihood.

A network sees (s, a) and predicts how the perceived state moves, in units of the perceptual width sigma_p: mean and log
standard deviation. From it comes the environment entropy of Eq. (6), measured against the perceptual kernel,

    H_T(s, a) = sum_i 1/2 log(1 + sigma_i(s, a)^2 / sigma_p^2),

which is 0 where the domain is deterministic.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import distrax
import jax
import jax.numpy as jnp
import optax
from flax import struct
from jax import Array

import peps_envs
from peps_jax.config import Config
from peps_jax.learning import replay
from peps_jax.learning.networks import MLP, apply_ensemble, feature_size, features_of, init_ensemble
from peps_jax.trajectory import Transition

MIN_LOG_SD, MAX_LOG_SD = -4.0, 3.0  # in units of sigma_p: the floor's entropy is below 2e-4 nats


@struct.dataclass
class DynamicsState:
    """The ensemble: parameters with a leading axis of members, and their optimizer's state."""

    params: Any
    optimizer: Any


class Prediction(NamedTuple):
    """Movement of the perceived state, in units of sigma_p."""

    mean: Array  # (..., perceived_size)
    log_sd: Array  # (..., perceived_size)


def _network(config: Config) -> MLP:
    environment, params, _ = config.task()
    return MLP(config.model_hidden_sizes, 2 * environment.perception_width(params).shape[0], output_scale=0.1)


def init(key: Array, config: Config) -> DynamicsState:
    """An untrained ensemble."""
    environment, _, _ = config.task()
    params = init_ensemble(_network(config), key, config.ensemble_size, feature_size(environment))
    return DynamicsState(params=params, optimizer=optax.adam(config.dynamics_learning_rate).init(params))


def predict(params: Any, observation: Array, action: Array, config: Config) -> Prediction:
    """One member's prediction."""
    environment, _, _ = config.task()
    outputs = _network(config).apply(params, features_of(environment.action_space)(observation, action))
    return _prediction(outputs)


def _prediction(outputs: Array) -> Prediction:
    mean, log_sd = jnp.split(outputs, 2, axis=-1)
    # soft bounds keep a gradient, where a clip would stop it
    log_sd = MAX_LOG_SD - jax.nn.softplus(MAX_LOG_SD - log_sd)
    return Prediction(mean=mean, log_sd=MIN_LOG_SD + jax.nn.softplus(log_sd - MIN_LOG_SD))


def movement(transition: Transition, environment: peps_envs.Environment, params: Any) -> Array:
    """What `predict` predicts: how the perceived state moved, in units of sigma_p, (perceived_size,)."""
    before = environment.perceive_observation(transition.observation, params)
    after = environment.perceive_observation(transition.next_observation, params)
    return (after - before) / environment.perception_width(params)


def loss(params: Any, transitions: Transition, config: Config) -> Array:
    """One member's mean negative log-likelihood, in nats per transition and up to a constant of the units."""
    environment, world, _ = config.task()
    prediction = predict(params, transitions.observation, transitions.action, config)
    density = distrax.MultivariateNormalDiag(prediction.mean, jnp.exp(prediction.log_sd))
    moved = jax.vmap(movement, in_axes=(0, None, None))(transitions, environment, world)
    return -jnp.mean(density.log_prob(moved))


def fit(
    state: DynamicsState, buffer: Transition, filled: Array, key: Array, config: Config
) -> tuple[DynamicsState, dict[str, Array]]:
    """`config.dynamics_updates` steps of Adam; each member draws minibatches of its own from the `filled` rows."""
    optimizer = optax.adam(config.dynamics_learning_rate)
    shape = (config.dynamics_updates, config.ensemble_size, config.batch_size)
    batches = replay.sample(buffer, key, shape, filled)

    def update(state: DynamicsState, batch: Transition) -> tuple[DynamicsState, Array]:
        losses, grads = jax.vmap(jax.value_and_grad(loss), in_axes=(0, 0, None))(state.params, batch, config)
        updates, optimizer_state = optimizer.update(grads, state.optimizer)
        return DynamicsState(optax.apply_updates(state.params, updates), optimizer_state), jnp.mean(losses)

    state, losses = jax.lax.scan(update, state, batches)
    return state, {"dynamics_loss": jnp.mean(losses)}


def environment_entropy(state: DynamicsState, observation: Array, action: Array, config: Config) -> Array:
    """H_T(s, a), (...): the members' mean variance (their disagreement is ignorance, not the domain's randomness)."""
    environment, _, _ = config.task()
    features = features_of(environment.action_space)(observation, action)
    log_sd = _prediction(apply_ensemble(_network(config))(state.params, features)).log_sd
    return 0.5 * jnp.sum(jnp.log1p(jnp.mean(jnp.exp(2 * log_sd), 0)), -1)
