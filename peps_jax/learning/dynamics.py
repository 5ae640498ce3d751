"""The learned dynamics T_A: an ensemble of Gaussian networks, fitted to replay by maximum likelihood.

A network sees (s, a) and predicts how the perceived state moves, in units of the perceptual width sigma_p: mean and log
standard deviation. From it comes the environment entropy of Eq. (6), measured against the perceptual kernel,

    H_T(s, a) = sum_i 1/2 log(1 + sigma_i(s, a)^2 / sigma_p^2),

which is 0 where the domain is deterministic.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import chex
import jax
import jax.numpy as jnp
import optax
from flax import struct
from jax import Array

from peps_jax.learning import replay
from peps_jax.learning.networks import MLP, apply_ensemble, feature_size, features_of, fit_ensemble, init_ensemble
from peps_jax.settings import DynamicsSettings
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


def _network(settings: DynamicsSettings) -> MLP:
    return MLP(settings.hidden_sizes, 2 * settings.perceived_size, output_scale=0.1)


def init(key: Array, settings: DynamicsSettings) -> DynamicsState:
    """An untrained ensemble."""
    size = feature_size(settings.observation_size, settings.action_space)
    params = init_ensemble(_network(settings), key, settings.ensemble_size, size)
    return DynamicsState(params=params, optimizer=optax.adam(settings.learning_rate).init(params))


def predict(params: Any, observation: Array, action: Array, settings: DynamicsSettings) -> Prediction:
    """One member's prediction."""
    features = features_of(settings.action_space)(observation, action)
    return _prediction(_network(settings).apply(params, features))


def _prediction(outputs: Array) -> Prediction:
    mean, log_sd = jnp.split(outputs, 2, axis=-1)
    # soft bounds keep a gradient, where a clip would stop it
    log_sd = MAX_LOG_SD - jax.nn.softplus(MAX_LOG_SD - log_sd)
    return Prediction(mean=mean, log_sd=MIN_LOG_SD + jax.nn.softplus(log_sd - MIN_LOG_SD))


def loss(params: Any, transitions: Transition, settings: DynamicsSettings) -> Array:
    """One member's mean negative log-likelihood, in nats per transition and up to a constant of the units."""
    import distrax  # takes half a second, which who doesn't train needn't wait

    prediction = predict(params, transitions.observation, transitions.action, settings)
    chex.assert_equal_shape([prediction.mean, transitions.movement])
    density = distrax.MultivariateNormalDiag(prediction.mean, jnp.exp(prediction.log_sd))
    return -jnp.mean(density.log_prob(transitions.movement))


def fit(
    state: DynamicsState, buffer: Transition, filled: Array, key: Array, settings: DynamicsSettings
) -> tuple[DynamicsState, dict[str, Array]]:
    """`settings.updates` steps of Adam; each member draws minibatches of its own from the `filled` rows of replay."""
    shape = (settings.updates, settings.ensemble_size, settings.batch_size)
    batches = replay.sample(buffer, key, shape, filled)
    of_one = lambda params, batch: (loss(params, batch, settings), None)
    *fitted, (losses, _) = fit_ensemble(
        of_one, optax.adam(settings.learning_rate), state.params, state.optimizer, batches
    )
    return DynamicsState(*fitted), {"dynamics_loss": jnp.mean(losses)}


def environment_entropy(state: DynamicsState, observation: Array, action: Array, settings: DynamicsSettings) -> Array:
    """H_T(s, a), (...): the members' mean variance (their disagreement is ignorance, not the domain's randomness)."""
    features = features_of(settings.action_space)(observation, action)
    log_sd = _prediction(apply_ensemble(_network(settings))(state.params, features)).log_sd
    return 0.5 * jnp.sum(jnp.log1p(jnp.mean(jnp.exp(2 * log_sd), 0)), -1)
