"""A classifier of domains: whether a next state is what the human imagines, or what happens (Eysenbach et al. 2021, DARC).

    log p(imagined | s, a, s') / p(happened | s, a, s') = l_H(s'|s, a) - l_A(s'|s, a)

where both come from the same states and actions equally often, and are seen through the same perceptual kernel.
"""

from __future__ import annotations

from typing import Any

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


@struct.dataclass
class ClassifierState:
    """The ensemble: parameters with a leading axis of members, and their optimizer's state."""

    params: Any
    optimizer: Any


def _network(settings: DynamicsSettings) -> MLP:
    return MLP(settings.hidden_sizes, 1)


def _features(observation: Array, action: Array, movement: Array, settings: DynamicsSettings) -> Array:
    return jnp.concatenate([features_of(settings.action_space)(observation, action), movement], -1)


def init(key: Array, settings: DynamicsSettings) -> ClassifierState:
    """An untrained ensemble."""
    size = feature_size(settings.observation_size, settings.action_space) + settings.perceived_size
    params = init_ensemble(_network(settings), key, settings.ensemble_size, size)
    return ClassifierState(params=params, optimizer=optax.adam(settings.learning_rate).init(params))


def loss(params: Any, transitions: Transition, noise: Array, settings: DynamicsSettings) -> Array:
    """One member's mean cross-entropy, in nats: log 2 where nothing tells the domains apart.

    `noise` (..., perceived_size) is the kernel's, standard normal, through which what happened is seen.
    """
    chex.assert_equal_shape([transitions.movement, transitions.imagined, noise])
    logit = lambda movement: _network(settings).apply(
        params, _features(transitions.observation, transitions.action, movement, settings)
    )[..., 0]
    happened, imagined = logit(transitions.movement + noise), logit(transitions.imagined)
    return 0.5 * jnp.mean(jax.nn.softplus(happened) + jax.nn.softplus(-imagined))


def fit(
    state: ClassifierState, buffer: Transition, filled: Array, keys: Array, settings: DynamicsSettings
) -> tuple[ClassifierState, dict[str, Array]]:
    """`settings.updates` steps of Adam; each member draws minibatches of its own from the `filled` rows of replay.

    `keys` (2,): of the minibatches and of the kernel's noise.
    """
    key_batch, key_noise = keys
    shape = (settings.updates, settings.ensemble_size, settings.batch_size)
    batches = replay.sample(buffer, key_batch, shape, filled)
    noises = jax.random.normal(key_noise, batches.movement.shape, jnp.float32)
    of_one = lambda params, batch, noise: (loss(params, batch, noise, settings), None)
    *fitted, (losses, _) = fit_ensemble(
        of_one, optax.adam(settings.learning_rate), state.params, state.optimizer, batches, noises
    )
    return ClassifierState(*fitted), {"classifier_loss": jnp.mean(losses)}


def log_ratio(state: ClassifierState, transitions: Transition, settings: DynamicsSettings) -> Array:
    """l_H - l_A of `transitions` (...), as the members think on average."""
    features = _features(transitions.observation, transitions.action, transitions.movement, settings)
    return jnp.mean(apply_ensemble(_network(settings))(state.params, features)[..., 0], 0)
