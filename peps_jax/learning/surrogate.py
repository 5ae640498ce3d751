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
from peps_jax.learning.networks import MLP, feature_size, features_of, fit_ensemble, init_ensemble
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
    """Preferences as a member's fit sees them."""

    features: Array  # (n, 2, steps, feature_size) of the segments
    mask: Array  # (n, 2, steps) bool
    reward: Array  # (n, 2, steps) r_A
    preferred: Array  # (n,) P(first preferred)
    weight: Array  # (n,) how much each counts


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


def counts(state: SurrogateState, preferences: PreferenceSet, settings: SurrogateSettings) -> Array:
    """How much each member's resample makes of each answer, (n, members): 0 of those that nobody has answered."""
    return resampled(state.bootstrap, preferences.number, settings.ensemble_size) * preferences.weight[:, None]


def _examples(preferences: PreferenceSet, settings: SurrogateSettings) -> Examples:
    """All preferences as examples, each as often as people said so."""
    return Examples(
        features=features_of(settings.action_space)(preferences.observation, preferences.action),
        mask=preferences.mask,
        reward=preferences.reward,
        preferred=preferences.preferred,
        weight=preferences.weight,
    )


def _minibatches(
    state: SurrogateState, preferences: PreferenceSet, key: Array, settings: SurrogateSettings
) -> Examples:
    """(updates, members, batch_size): each member draws from its own resample, an answer as often as that makes much of it.

    Weighing shared minibatches by Poisson counts costs twice as much for the same variance. They are drawn in the order of their
    numbers, so that it makes no difference in which order they came. A member without any answer has examples of weight 0.
    """
    order = jnp.argsort(jnp.where(preferences.weight > 0, preferences.number, MOST))
    reach = jnp.cumsum(counts(state, preferences, settings)[order], 0).T  # (members, n)
    shape = (settings.updates, settings.batch_size)
    drawn = jax.random.uniform(key, (settings.ensemble_size, *shape), jnp.float32)
    find = lambda reach, drawn: jnp.searchsorted(reach, drawn * reach[-1], side="right")
    index = order[jnp.moveaxis(jax.vmap(find)(reach, drawn), 0, 1)]
    rows = jax.tree.map(lambda rows: rows[index], _examples(preferences, settings))
    there = jnp.broadcast_to((reach[:, -1] > 0)[None, :, None], index.shape)
    return rows._replace(weight=there.astype(jnp.float32))


# --- likelihood -----------------------------------------------------------------------------------------------------------


def _rewards(params: Any, features: Array, reward: Array, settings: SurrogateSettings) -> Array:
    """One member's r_hat, (...), from features (..., n) of (s, a) and the rewards r_A that were observed, (...)."""
    outputs = _network(settings).apply(params, features)[..., 0]
    if settings.prior == "none":
        return outputs
    if math.isfinite(settings.bound):
        untaught = settings.bound + math.log(-math.expm1(-settings.bound))  # its softplus is the bound
        outputs = settings.bound - jax.nn.softplus(untaught - outputs)
    return reward + outputs


def segment_sums(params: Any, features: Array, mask: Array, reward: Array, settings: SurrogateSettings) -> Array:
    """sum_t r_hat over segments, by one member: (...) from features (..., steps, n) and mask (..., steps)."""
    chex.assert_equal_shape_prefix([features, mask], mask.ndim)
    return jnp.sum(jnp.where(mask, _rewards(params, features, reward, settings), 0.0), -1)


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
    sums = jax.vmap(lambda params: segment_sums(params, features, segments.mask, segments.reward, settings))(
        state.params
    )
    return answer_logits(sums[..., 0] - sums[..., 1], settings.uniform_answers)


def loss(params: Any, examples: Examples, settings: SurrogateSettings) -> tuple[Array, Array]:
    """One member's mean Bradley-Terry cross-entropy over its examples, and its accuracy; log 2 at a tie."""
    chex.assert_equal_shape_prefix(list(examples), 1)
    sums = segment_sums(params, examples.features, examples.mask, examples.reward, settings)
    # logits, because exp overflows on long segments
    logits = answer_logits(sums[:, 0] - sums[:, 1], settings.uniform_answers)
    mean = lambda values, weight: jnp.sum(values * weight) / jnp.maximum(jnp.sum(weight), 1.0)
    decided = jnp.where(examples.preferred != 0.5, examples.weight, 0.0)
    right = (logits > 0) == (examples.preferred > 0.5)
    return mean(optax.sigmoid_binary_cross_entropy(logits, examples.preferred), examples.weight), mean(right, decided)


# --- the fit --------------------------------------------------------------------------------------------------------------


def fit(
    state: SurrogateState, preferences: PreferenceSet, key: Array, settings: SurrogateSettings
) -> tuple[SurrogateState, dict[str, Array]]:
    """`settings.updates` steps of AdamW on what was answered. Preferences of weight 0 weigh nothing."""
    minibatches = _minibatches(state, preferences, key, settings)
    of_one = lambda params, examples: loss(params, examples, settings)
    optimizer = _optimizer(settings, state.decay)
    params, optimizer_state, (losses, correct) = fit_ensemble(
        of_one, optimizer, state.params, state.optimizer, minibatches
    )
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
    examples = _examples(preferences, settings)

    def over(weights: Array) -> Array:
        of_one = lambda params, weight: loss(params, examples._replace(weight=weight), settings)[0]
        each, total = jax.vmap(of_one)(state.params, weights.T), jnp.sum(weights, 0)
        return jnp.sum(each * total) / jnp.maximum(jnp.sum(total), 1.0)

    trained = counts(state, preferences, settings)
    held_out = jnp.where(trained == 0, preferences.weight[:, None], 0.0)
    training, validation = over(trained), over(held_out)
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
    return jax.vmap(lambda params: _rewards(params, features, reward, settings))(state.params)


def predict(
    state: SurrogateState, observation: Array, action: Array, reward: Array, settings: SurrogateSettings
) -> Array:
    """r_hat(s, a), (...): the mean of the members at their levels."""
    rewards = member_rewards(state, observation, action, reward, settings)
    levelled = jax.vmap(lambda rewards, shift, scale: (rewards - shift) / scale)(rewards, state.shift, state.scale)
    return jnp.mean(levelled, 0)
