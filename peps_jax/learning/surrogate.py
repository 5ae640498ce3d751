"""The surrogate reward r-hat of Eq. (5): an ensemble on (s, a), fitted to preferences by Bradley-Terry cross-entropy.

    P(first preferred) = sigmoid(sum_t r_hat(s1_t, a1_t) - sum_t r_hat(s2_t, a2_t))        (Sec. 4.2)

One function carries both biases of the human, of the belief and of the reward. Preferences between segments of one length
leave r-hat's level free, a constant per step. In an episodic task such a constant pays the agent for staying alive or charges
it, so the level has to be pinned: queries with segments of unequal lengths identify it from the answers themselves.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from flax import struct
from jax import Array

from peps_jax.config import Config
from peps_jax.learning import replay
from peps_jax.learning.networks import MLP, apply_ensemble, feature_size, features_of, init_ensemble
from peps_jax.trajectory import Preferences, Segments, Transition

VALIDATION_RATIO = (1.1, 1.5)  # bounds on validation loss / training loss that an adapted weight decay aims at
DECAY_STEP = 1.5  # factor by which a round moves it
DECAY_BOUNDS = (1e-6, 10.0)


class Recipe(NamedTuple):
    """How r-hat is learned, where methods differ."""

    level: str | None = None  # one of `config.LEVELS`; None: `Config.level`
    uniform_answers: float = 0.0  # probability, assumed in the likelihood, that the human answers uniformly at random
    validates: bool = False  # whether weight decay follows the loss on what a member's resample left out


PLAIN = Recipe()


@struct.dataclass
class SurrogateState:
    """The ensemble, what it was taught, and the level."""

    params: Any  # leading axis: members
    optimizer: Any
    features: Array  # (capacity, 2, steps, feature_size) of the segments compared so far
    mask: Array  # (capacity, 2, steps)
    answers: Array  # (capacity,) P(first preferred)
    weights: Array  # (capacity, members) how often each member's resample holds the preference
    answered: Array  # (capacity,) 1.0 where the teacher answered
    decay: Array  # () weight decay of the fit
    shift: Array  # (members,) subtracted from each member's rewards
    scale: Array  # (members,) divides them


def _network(config: Config) -> MLP:
    return MLP(config.model_hidden_sizes, 1, output_scale=0.1)


def _optimizer(config: Config, decay: Array) -> optax.GradientTransformation:
    return optax.adamw(config.surrogate_learning_rate, weight_decay=decay)


def init(key: Array, config: Config) -> SurrogateState:
    """An untrained ensemble without preferences."""
    environment, _, _ = config.task()
    size, steps = feature_size(environment), config.segment_length
    capacity = config.queries_per_round * config.num_rounds
    params = init_ensemble(_network(config), key, config.ensemble_size, size)
    decay = jnp.asarray(config.surrogate_decay, jnp.float32)
    return SurrogateState(
        params=params,
        optimizer=_optimizer(config, decay).init(params),
        features=jnp.zeros((capacity, 2, steps, size)),
        mask=jnp.zeros((capacity, 2, steps)),
        answers=jnp.zeros(capacity),
        weights=jnp.zeros((capacity, config.ensemble_size)),
        answered=jnp.zeros(capacity),
        decay=decay,
        shift=jnp.zeros(config.ensemble_size),
        scale=jnp.ones(config.ensemble_size),
    )


def add(state: SurrogateState, preferences: Preferences, position: Array, key: Array, config: Config) -> SurrogateState:
    """Writes `preferences` at `position`. A member's resample holds each one Poisson(1) times, as a bootstrap would."""
    environment, _, _ = config.task()
    segments = preferences.segments
    number = preferences.answers.shape[0]
    asked = jnp.arange(number) + position < config.num_queries  # the last round may ask more than the budget has left
    copies = jax.random.poisson(key, 1.0, (number, config.ensemble_size)).astype(jnp.float32)
    answered = preferences.answered * asked
    write = lambda rows, new: jax.lax.dynamic_update_slice_in_dim(rows, new, position, 0)
    return state.replace(
        features=write(state.features, features_of(environment.action_space)(segments.observation, segments.action)),
        mask=write(state.mask, segments.mask),
        answers=write(state.answers, preferences.answers),
        weights=write(state.weights, copies * answered[:, None]),
        answered=write(state.answered, answered),
    )


def segment_sums(params: Any, features: Array, mask: Array, config: Config) -> Array:
    """sum_t r_hat over segments, by every member: (members, ...) from features (..., steps, n) and mask (..., steps)."""
    rewards = apply_ensemble(_network(config))(params, features)[..., 0]
    return jnp.sum(rewards * mask[None], -1)


def answer_logits(difference: Array, recipe: Recipe) -> Array:
    """log P / (1 - P) of the first segment being preferred, from r_hat's sum over the first less that over the second.

    P = u / 2 + (1 - u) sigmoid(difference), with u the recipe's `uniform_answers` (Christiano et al. 2017, Sec. 2.2.3): an error
    costs at most log(u / 2), however large the difference.
    """
    if not recipe.uniform_answers:
        return difference
    random, considered = jnp.log(recipe.uniform_answers / 2), jnp.log1p(-recipe.uniform_answers)
    log_probability = lambda difference: jnp.logaddexp(random, considered + jax.nn.log_sigmoid(difference))
    return log_probability(difference) - log_probability(-difference)


def preference_logits(state: SurrogateState, segments: Segments, config: Config, recipe: Recipe = PLAIN) -> Array:
    """log P / (1 - P) of the first segment being preferred, by every member: (members, n) from pairs (n, 2, steps, ...)."""
    environment, _, _ = config.task()
    features = features_of(environment.action_space)(segments.observation, segments.action)
    sums = segment_sums(state.params, features, segments.mask, config)
    return answer_logits(sums[..., 0] - sums[..., 1], recipe)


def loss(
    params: Any,
    features: Array,
    mask: Array,
    answers: Array,
    weights: Array,
    config: Config,
    recipe: Recipe = PLAIN,
) -> tuple[Array, Array]:
    """Bradley-Terry cross-entropy of all members over queries (n, 2, steps, ...), and their accuracy; log 2 at a tie.

    `weights` (n, members) is how often each member sees each query.
    """
    sums = segment_sums(params, features, mask, config)
    # (members, n); logits, because exp overflows on long segments
    logits = answer_logits(sums[..., 0] - sums[..., 1], recipe)
    cross_entropy = optax.sigmoid_binary_cross_entropy(logits, answers[None])
    total = jnp.maximum(jnp.sum(weights), 1.0)
    decided = weights.T * (answers != 0.5)[None]
    correct = jnp.sum(decided * ((logits > 0) == (answers > 0.5)[None])) / jnp.maximum(jnp.sum(decided), 1.0)
    return jnp.sum(weights.T * cross_entropy) / total, correct


def fit(
    state: SurrogateState,
    buffer: Transition,
    known: Array,
    filled: Array,
    key: Array,
    config: Config,
    recipe: Recipe = PLAIN,
) -> tuple[SurrogateState, dict[str, Array]]:
    """`config.surrogate_updates` steps of AdamW on the first `known` preferences, then the level over replay."""
    optimizer = _optimizer(config, state.decay)
    key_batch, key_level = jax.random.split(key)
    index = jax.random.randint(key_batch, (config.surrogate_updates, config.surrogate_batch_size), 0, known)

    def update(carry: tuple[Any, Any], index: Array) -> tuple[tuple[Any, Any], tuple[Array, Array]]:
        params, optimizer_state = carry
        rows = (state.features[index], state.mask[index], state.answers[index], state.weights[index])
        info, grads = jax.value_and_grad(loss, has_aux=True)(params, *rows, config, recipe)
        updates, optimizer_state = optimizer.update(grads, optimizer_state, params)
        return (optax.apply_updates(params, updates), optimizer_state), info

    (params, optimizer_state), (losses, correct) = jax.lax.scan(update, (state.params, state.optimizer), index)
    state = state.replace(params=params, optimizer=optimizer_state)
    info = {"surrogate_loss": jnp.mean(losses), "preference_accuracy": jnp.mean(correct)}
    if recipe.validates:
        state, validated = _adapt(state, config, recipe)
        info |= validated
    visited = replay.sample(buffer, key_level, (1024,), filled)
    return _pin(state, visited, config.level if recipe.level is None else recipe.level, config), info


def _adapt(state: SurrogateState, config: Config, recipe: Recipe) -> tuple[SurrogateState, dict[str, Array]]:
    """Moves the weight decay up where validation loss / training loss is above `VALIDATION_RATIO`, down where it is below.

    A member is validated on the answers that its resample holds 0 times: 1/e of them (Christiano et al. 2017, Sec. 2.2.3).
    """
    held_out = (state.weights == 0) * state.answered[:, None]
    both = jnp.stack([state.weights, held_out])
    over = jax.vmap(loss, in_axes=(None, None, None, None, 0, None, None))
    (training, validation), _ = over(state.params, state.features, state.mask, state.answers, both, config, recipe)
    low, high = VALIDATION_RATIO
    ratio = validation / jnp.maximum(training, 1e-6)
    factor = jnp.where(ratio > high, DECAY_STEP, jnp.where(ratio < low, 1 / DECAY_STEP, 1.0))
    decay = jnp.clip(state.decay * factor, *DECAY_BOUNDS)
    info = {"surrogate_validation_ratio": ratio, "surrogate_decay": decay}
    return state.replace(decay=decay), info


def _pin(state: SurrogateState, visited: Transition, level: str, config: Config) -> SurrogateState:
    """Sets shift and scale from what r-hat says of `visited` transitions.

    "quantile" puts the ensemble's 0.95 quantile at 0 and its 0.05 quantile at -1, "max" its maximum at 0, "standard" every
    member's mean at 0 and its standard deviation at 1 (Christiano et al. 2017, Sec. 2.2.3); "none" takes r-hat as it is.
    """
    raw = member_rewards(state, visited.observation, visited.action, config)
    everyone = lambda value: jnp.broadcast_to(value, state.shift.shape)
    if level == "max":
        return state.replace(shift=everyone(jnp.max(jnp.mean(raw, 0))))
    if level == "quantile":
        low, high = jnp.quantile(jnp.mean(raw, 0), jnp.array([0.05, 0.95]))
        return state.replace(shift=everyone(high), scale=everyone(jnp.maximum(high - low, 1e-3)))
    if level == "standard":
        return state.replace(shift=jnp.mean(raw, -1), scale=jnp.maximum(jnp.std(raw, -1), 1e-3))
    return state


def member_rewards(state: SurrogateState, observation: Array, action: Array, config: Config) -> Array:
    """Each member's r_hat(s, a) before its level is set, (members, ...)."""
    environment, _, _ = config.task()
    features = features_of(environment.action_space)(observation, action)
    return apply_ensemble(_network(config))(state.params, features)[..., 0]


def predict(state: SurrogateState, observation: Array, action: Array, config: Config) -> Array:
    """r_hat(s, a), (...): the mean of the members at their levels."""
    rewards = member_rewards(state, observation, action, config)
    levelled = jax.vmap(lambda rewards, shift, scale: (rewards - shift) / scale)(rewards, state.shift, state.scale)
    return jnp.mean(levelled, 0)
