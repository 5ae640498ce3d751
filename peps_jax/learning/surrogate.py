"""The surrogate reward r-hat of Eq. (5): an ensemble on (s, a), fitted to preferences by Bradley-Terry cross-entropy.

    P(first preferred) = sigmoid(sum_t r_hat(s1_t, a1_t) - sum_t r_hat(s2_t, a2_t))        (Sec. 4.2)

One function carries both biases of the human, of the belief and of the reward. Preferences between segments of one length
leave r-hat's level free, a constant per step. In an episodic task such a constant pays the agent for staying alive or charges
it, so the level has to be pinned: queries with segments of unequal lengths identify it from the answers themselves.

People mostly want the task done. So r-hat may be learned as a difference from the reward that the agent observed,

    r_hat(s, a, r) = r + bound - softplus(c - f(s, a)),    softplus(c) = bound,

0 above it where the network f is 0, as before the first answer, and nowhere more than `bound`. Were belief and reward not biased,
r_H + l_H would be r_A + l_H, and l_H is at most 0: what surprises costs, and nothing is worth much more than it pays. Few answers
then can't make a walk in circles worth more than the goal.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import chex
import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import struct
from jax import Array

from peps_jax import generator
from peps_jax.fields import MOST
from peps_jax.learning.networks import MLP, apply_ensemble, feature_size, features_of, init_ensemble
from peps_jax.preferences.data import PreferenceSet, Segments
from peps_jax.settings import SurrogateSettings

VALIDATION_RATIO = (1.1, 1.5)  # bounds on validation loss / training loss that an adapted weight decay aims at
DECAY_STEP = 1.5  # factor by which a round moves it
DECAY_BOUNDS = (1e-6, 10.0)


@struct.dataclass
class SurrogateState:
    """The ensemble, and the level of its rewards."""

    params: Any  # leading axis: members
    optimizer: Any
    bootstrap: Array  # (2,) data of the random key that decides the members' resamples
    decay: Array  # () weight decay of the fit
    shift: Array  # (members,) subtracted from each member's rewards
    scale: Array  # (members,) divides them


class Examples(NamedTuple):
    """Preferences as the fit sees them."""

    features: Array  # (n, 2, steps, feature_size) of the segments
    mask: Array  # (n, 2, steps) bool
    reward: Array  # (n, 2, steps) r_A
    preferred: Array  # (n,) P(first preferred)
    weights: Array  # (n, members) how much each member's resample makes of each


def _network(settings: SurrogateSettings) -> MLP:
    return MLP(settings.hidden_sizes, 1, output_scale=0.1)


def _optimizer(settings: SurrogateSettings, decay: Array) -> optax.GradientTransformation:
    return optax.adamw(settings.learning_rate, weight_decay=decay)


def init(key: Array, settings: SurrogateSettings) -> SurrogateState:
    """An untrained ensemble."""
    size = feature_size(settings.observation_size, settings.action_space)
    params = init_ensemble(_network(settings), key, settings.ensemble_size, size)
    decay = jnp.asarray(settings.decay, jnp.float32)
    return SurrogateState(
        params=params,
        optimizer=_optimizer(settings, decay).init(params),
        bootstrap=jax.random.key_data(jax.random.fold_in(key, 1)),
        decay=decay,
        shift=jnp.zeros(settings.ensemble_size, jnp.float32),
        scale=jnp.ones(settings.ensemble_size, jnp.float32),
    )


# --- preferences ----------------------------------------------------------------------------------------------------------

# P(at most k) of a Poisson distribution of mean 1, k = 0, 1, ...; beyond the last lies less than 1e-7
_POISSON = np.cumsum([math.exp(-1) / math.factorial(count) for count in range(10)]).astype(np.float32)


def resampled(bootstrap: Array, number: Array, members: int) -> Array:
    """How often each member's resample holds the queries called `number` (n,): (n, members), Poisson(1) as in a bootstrap.

    It follows from a query's identity alone, whenever and in whatever order answers come.
    """
    key = generator.wrap(bootstrap)
    draw = lambda number: jax.random.uniform(jax.random.fold_in(key, number), (members,), jnp.float32)
    uniform = jax.vmap(draw)(number)
    return jnp.sum(uniform[..., None] > jnp.asarray(_POISSON)[None, None], -1).astype(jnp.float32)


def _examples(state: SurrogateState, preferences: PreferenceSet, settings: SurrogateSettings) -> Examples:
    """All preferences as examples; those that nobody has answered weigh nothing."""
    copies = resampled(state.bootstrap, preferences.number, settings.ensemble_size)
    return Examples(
        features=features_of(settings.action_space)(preferences.observation, preferences.action),
        mask=preferences.mask,
        reward=preferences.reward,
        preferred=preferences.preferred,
        weights=copies * preferences.weight[:, None],
    )


def _minibatches(key: Array, preferences: PreferenceSet, settings: SurrogateSettings) -> PreferenceSet:
    """(updates, batch_size) of the answered preferences, drawn uniformly.

    They are drawn in the order of their numbers, so that it makes no difference in which order they came.
    """
    there = preferences.weight > 0
    order = jnp.argsort(jnp.where(there, preferences.number, MOST))
    shape = (settings.updates, settings.batch_size)
    drawn = jax.random.randint(key, shape, 0, jnp.maximum(jnp.sum(there, dtype=jnp.int32), 1), jnp.int32)
    return jax.tree.map(lambda rows: rows[order[drawn]], preferences)


# --- likelihood -----------------------------------------------------------------------------------------------------------


def _rewards(params: Any, features: Array, reward: Array, settings: SurrogateSettings) -> Array:
    """Each member's r_hat, (members, ...), from features (..., n) of (s, a) and the rewards r_A that were observed, (...)."""
    outputs = apply_ensemble(_network(settings))(params, features)[..., 0]
    if settings.prior == "none":
        return outputs
    if math.isfinite(settings.bound):
        untaught = settings.bound + math.log(-math.expm1(-settings.bound))  # its softplus is the bound
        outputs = settings.bound - jax.nn.softplus(untaught - outputs)
    return reward[None] + outputs


def segment_sums(params: Any, features: Array, mask: Array, reward: Array, settings: SurrogateSettings) -> Array:
    """sum_t r_hat over segments, by every member: (members, ...) from features (..., steps, n) and mask (..., steps)."""
    chex.assert_equal_shape_prefix([features, mask], mask.ndim)
    rewards = _rewards(params, features, reward, settings)
    return jnp.sum(jnp.where(mask[None], rewards, 0.0), -1)


def answer_logits(difference: Array, uniform_answers: float) -> Array:
    """log P / (1 - P) of the first segment being preferred, from r_hat's sum over the first less that over the second.

    P = u / 2 + (1 - u) sigmoid(difference), u the share of answers that are taken for random (Christiano et al. 2017,
    Sec. 2.2.3): an error costs at most log(u / 2), however large the difference.
    """
    if not uniform_answers:
        return difference
    random, considered = math.log(uniform_answers / 2), math.log1p(-uniform_answers)
    log_probability = lambda difference: jnp.logaddexp(random, considered + jax.nn.log_sigmoid(difference))
    return log_probability(difference) - log_probability(-difference)


def preference_logits(state: SurrogateState, segments: Segments, settings: SurrogateSettings) -> Array:
    """log P / (1 - P) of the first segment being preferred, by every member: (members, n) from pairs (n, 2, steps, ...)."""
    features = features_of(settings.action_space)(segments.observation, segments.action)
    sums = segment_sums(state.params, features, segments.mask, segments.reward, settings)
    return answer_logits(sums[..., 0] - sums[..., 1], settings.uniform_answers)


def loss(params: Any, examples: Examples, settings: SurrogateSettings) -> tuple[Array, Array]:
    """Bradley-Terry cross-entropy of all members over their examples, and their accuracy; log 2 at a tie."""
    chex.assert_equal_shape_prefix(list(examples), 1)
    sums = segment_sums(params, examples.features, examples.mask, examples.reward, settings)
    # (members, n); logits, because exp overflows on long segments
    logits = answer_logits(sums[..., 0] - sums[..., 1], settings.uniform_answers)
    preferred, weights = examples.preferred[None], examples.weights.T
    cross_entropy = optax.sigmoid_binary_cross_entropy(logits, preferred)
    total = jnp.maximum(jnp.sum(weights), 1.0)
    decided = jnp.where(preferred != 0.5, weights, 0.0)
    right = (logits > 0) == (preferred > 0.5)
    correct = jnp.sum(jnp.where(right, decided, 0.0)) / jnp.maximum(jnp.sum(decided), 1.0)
    return jnp.sum(weights * cross_entropy) / total, correct


# --- the fit --------------------------------------------------------------------------------------------------------------


def fit(
    state: SurrogateState, preferences: PreferenceSet, key: Array, settings: SurrogateSettings
) -> tuple[SurrogateState, dict[str, Array]]:
    """`settings.updates` steps of AdamW on what was answered. Preferences of weight 0 weigh nothing."""
    optimizer = _optimizer(settings, state.decay)

    def update(carry: tuple[Any, Any], rows: PreferenceSet) -> tuple[tuple[Any, Any], tuple[Array, Array]]:
        params, optimizer_state = carry
        examples = _examples(state, rows, settings)
        info, grads = jax.value_and_grad(loss, has_aux=True)(params, examples, settings)
        updates, optimizer_state = optimizer.update(grads, optimizer_state, params)
        return (optax.apply_updates(params, updates), optimizer_state), info

    minibatches = _minibatches(key, preferences, settings)
    (params, optimizer_state), (losses, correct) = jax.lax.scan(update, (state.params, state.optimizer), minibatches)
    state = state.replace(params=params, optimizer=optimizer_state)
    info = {"surrogate_loss": jnp.mean(losses), "preference_accuracy": jnp.mean(correct)}
    if settings.validates:
        state, validated = _adapt(state, preferences, settings)
        info |= validated
    return state, info


def _adapt(
    state: SurrogateState, preferences: PreferenceSet, settings: SurrogateSettings
) -> tuple[SurrogateState, dict[str, Array]]:
    """Moves the weight decay up where validation loss / training loss is above `VALIDATION_RATIO`, down where it is below.

    A member is validated on the answers that its resample holds 0 times: 1/e of them (Christiano et al. 2017, Sec. 2.2.3).
    """
    examples = _examples(state, preferences, settings)
    held_out = jnp.where(examples.weights == 0, preferences.weight[:, None], 0.0)
    over = jax.vmap(lambda weights: loss(state.params, examples._replace(weights=weights), settings)[0])
    training, validation = over(jnp.stack([examples.weights, held_out]))
    low, high = VALIDATION_RATIO
    ratio = validation / jnp.maximum(training, 1e-6)
    factor = jnp.where(ratio > high, DECAY_STEP, jnp.where(ratio < low, 1 / DECAY_STEP, 1.0))
    decay = jnp.clip(state.decay * factor, *DECAY_BOUNDS)
    info = {"surrogate_validation_ratio": ratio, "surrogate_decay": decay}
    return state.replace(decay=decay), info


# --- the reward -----------------------------------------------------------------------------------------------------------


def pin(
    state: SurrogateState, observation: Array, action: Array, reward: Array, settings: SurrogateSettings
) -> SurrogateState:
    """Sets shift and scale from what r-hat says of (s, a) that were visited, (n, ...).

    "quantile" puts the ensemble's 0.95 quantile at 0 and its 0.05 quantile at -1, "max" its maximum at 0, "standard" every
    member's mean at 0 and its standard deviation at 1 (Christiano et al. 2017, Sec. 2.2.3); "none" takes r-hat as it is.
    """
    raw = member_rewards(state, observation, action, reward, settings)
    everyone = lambda value: jnp.broadcast_to(value, state.shift.shape)
    if settings.level == "max":
        return state.replace(shift=everyone(jnp.max(jnp.mean(raw, 0))))
    if settings.level == "quantile":
        low, high = jnp.quantile(jnp.mean(raw, 0), jnp.array([0.05, 0.95], jnp.float32))
        return state.replace(shift=everyone(high), scale=everyone(jnp.maximum(high - low, 1e-3)))
    if settings.level == "standard":
        return state.replace(shift=jnp.mean(raw, -1), scale=jnp.maximum(jnp.std(raw, -1), 1e-3))
    return state


def member_rewards(
    state: SurrogateState, observation: Array, action: Array, reward: Array, settings: SurrogateSettings
) -> Array:
    """Each member's r_hat(s, a) before its level is set, (members, ...)."""
    features = features_of(settings.action_space)(observation, action)
    return _rewards(state.params, features, reward, settings)


def predict(
    state: SurrogateState, observation: Array, action: Array, reward: Array, settings: SurrogateSettings
) -> Array:
    """r_hat(s, a), (...): the mean of the members at their levels."""
    rewards = member_rewards(state, observation, action, reward, settings)
    levelled = jax.vmap(lambda rewards, shift, scale: (rewards - shift) / scale)(rewards, state.shift, state.scale)
    return jnp.mean(levelled, 0)
