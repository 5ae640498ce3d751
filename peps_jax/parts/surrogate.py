"""The surrogate reward r-hat of Eq. (5): an ensemble on (s, a), fitted to preferences by Bradley-Terry cross-entropy.

    P(first preferred) = sigmoid(sum_t r_hat(s1_t, a1_t) - sum_t r_hat(s2_t, a2_t))        (Sec. 4.2)

One function carries both biases of the human, of the belief and of the reward. Preferences between segments of one length
leave r-hat's level free, a constant per step. In an episodic task such a constant pays the agent for staying alive or charges
it, so the level has to be pinned: queries with segments of unequal lengths identify it from the answers themselves.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import optax
from flax import struct
from jax import Array

from peps_jax.config import Config
from peps_jax.parts import replay
from peps_jax.parts.networks import MLP, apply_ensemble, feature_size, features_of, init_ensemble
from peps_jax.parts.trajectory import Preferences, Segments, Transition


@struct.dataclass
class SurrogateState:
    """The ensemble, what it was taught, and the level."""

    params: Any  # leading axis: members
    optimizer: Any
    features: Array  # (capacity, 2, steps, feature_size) of the segments compared so far
    mask: Array  # (capacity, 2, steps)
    answers: Array  # (capacity,) P(first preferred)
    weights: Array  # (capacity, members) how often each member's resample holds the preference
    shift: Array  # () subtracted from the ensemble's mean
    scale: Array  # () divides it


def _network(config: Config) -> MLP:
    return MLP(config.model_hidden_sizes, 1, output_scale=0.1)


def _optimizer(config: Config) -> optax.GradientTransformation:
    return optax.adamw(config.surrogate_learning_rate, weight_decay=config.surrogate_decay)


def init(key: Array, config: Config) -> SurrogateState:
    """An untrained ensemble without preferences."""
    environment, _, _ = config.task()
    size, steps = feature_size(environment), config.segment_length
    capacity = config.queries_per_round * config.num_rounds
    params = init_ensemble(_network(config), key, config.ensemble_size, size)
    return SurrogateState(
        params=params,
        optimizer=_optimizer(config).init(params),
        features=jnp.zeros((capacity, 2, steps, size)),
        mask=jnp.zeros((capacity, 2, steps)),
        answers=jnp.zeros(capacity),
        weights=jnp.zeros((capacity, config.ensemble_size)),
        shift=jnp.zeros(()),
        scale=jnp.ones(()),
    )


def add(state: SurrogateState, preferences: Preferences, position: Array, key: Array, config: Config) -> SurrogateState:
    """Writes `preferences` at `position`. A member's resample holds each one Poisson(1) times, as a bootstrap would."""
    environment, _, _ = config.task()
    segments = preferences.segments
    number = preferences.answers.shape[0]
    asked = jnp.arange(number) + position < config.num_queries  # the last round may ask more than the budget has left
    copies = jax.random.poisson(key, 1.0, (number, config.ensemble_size)).astype(jnp.float32)
    write = lambda rows, new: jax.lax.dynamic_update_slice_in_dim(rows, new, position, 0)
    return state.replace(
        features=write(state.features, features_of(environment.action_space)(segments.observation, segments.action)),
        mask=write(state.mask, segments.mask),
        answers=write(state.answers, preferences.answers),
        weights=write(state.weights, copies * (preferences.answered * asked)[:, None]),
    )


def segment_sums(params: Any, features: Array, mask: Array, config: Config) -> Array:
    """sum_t r_hat over segments, by every member: (members, ...) from features (..., steps, n) and mask (..., steps)."""
    rewards = apply_ensemble(_network(config))(params, features)[..., 0]
    return jnp.sum(rewards * mask[None], -1)


def preference_logits(state: SurrogateState, segments: Segments, config: Config) -> Array:
    """log P / (1 - P) of the first segment being preferred, by every member: (members, n) from pairs (n, 2, steps, ...)."""
    environment, _, _ = config.task()
    features = features_of(environment.action_space)(segments.observation, segments.action)
    sums = segment_sums(state.params, features, segments.mask, config)
    return sums[..., 0] - sums[..., 1]


def loss(
    params: Any, features: Array, mask: Array, answers: Array, weights: Array, config: Config
) -> tuple[Array, Array]:
    """Bradley-Terry cross-entropy of all members over queries (n, 2, steps, ...), and their accuracy; log 2 at a tie.

    `weights` (n, members) is how often each member sees each query.
    """
    sums = segment_sums(params, features, mask, config)
    logits = sums[..., 0] - sums[..., 1]  # (members, n); logits, because exp overflows on long segments
    cross_entropy = optax.sigmoid_binary_cross_entropy(logits, answers[None])
    total = jnp.maximum(jnp.sum(weights), 1.0)
    decided = weights.T * (answers != 0.5)[None]
    correct = jnp.sum(decided * ((logits > 0) == (answers > 0.5)[None])) / jnp.maximum(jnp.sum(decided), 1.0)
    return jnp.sum(weights.T * cross_entropy) / total, correct


def fit(
    state: SurrogateState, buffer: Transition, known: Array, filled: Array, key: Array, config: Config
) -> tuple[SurrogateState, dict[str, Array]]:
    """`config.surrogate_updates` steps of AdamW on the first `known` preferences, then the level over replay."""
    optimizer = _optimizer(config)
    key_batch, key_level = jax.random.split(key)
    index = jax.random.randint(key_batch, (config.surrogate_updates, config.surrogate_batch_size), 0, known)

    def update(carry: tuple[Any, Any], index: Array) -> tuple[tuple[Any, Any], tuple[Array, Array]]:
        params, optimizer_state = carry
        rows = (state.features[index], state.mask[index], state.answers[index], state.weights[index])
        info, grads = jax.value_and_grad(loss, has_aux=True)(params, *rows, config)
        updates, optimizer_state = optimizer.update(grads, optimizer_state, params)
        return (optax.apply_updates(params, updates), optimizer_state), info

    (params, optimizer_state), (losses, correct) = jax.lax.scan(update, (state.params, state.optimizer), index)
    state = state.replace(params=params, optimizer=optimizer_state)
    state = _pin(state, replay.sample(buffer, key_level, (1024,), filled), config)
    return state, {"surrogate_loss": jnp.mean(losses), "preference_accuracy": jnp.mean(correct)}


def _pin(state: SurrogateState, visited: Transition, config: Config) -> SurrogateState:
    """Sets shift and scale from what r-hat says of `visited` transitions, by `config.level`."""
    raw = predict(state.replace(shift=jnp.zeros(()), scale=jnp.ones(())), visited.observation, visited.action, config)
    if config.level == "max":
        return state.replace(shift=jnp.max(raw))
    if config.level == "quantile":
        low, high = jnp.quantile(raw, jnp.array([0.05, 0.95]))
        return state.replace(shift=high, scale=jnp.maximum(high - low, 1e-3))
    return state


def predict(state: SurrogateState, observation: Array, action: Array, config: Config) -> Array:
    """r_hat(s, a), (...): the members' mean, at its level."""
    environment, _, _ = config.task()
    features = features_of(environment.action_space)(observation, action)
    rewards = apply_ensemble(_network(config))(state.params, features)[..., 0]
    return (jnp.mean(rewards, 0) - state.shift) / state.scale
