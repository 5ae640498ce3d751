"""How people see a next state, and densities of what they see.

Nobody sees a position exactly. Every next state is compared through a Gaussian kernel K = N(0, sigma_p^2 I) of the width that
people can tell apart, so that a belief's density is T convolved with K. This keeps every log-density finite, for a
deterministic model too, and log K(0) is the base measure by which a perfect prediction scores 0:

    l(s'|s,a) = log (T * K)(s'|s,a) - log K(0).
"""

from __future__ import annotations

import abc
import math

import jax
import jax.numpy as jnp
from flax import struct
from jax import Array


class PerceivedDensity(abc.ABC):
    """Density of the next state as perceived, T * K at one state and action.

    Attributes:
      width: sigma_p, the kernel's standard deviations, (perceived_size,).
    """

    width: Array

    @abc.abstractmethod
    def relative_log_prob(self, perceived: Array) -> Array:
        """l(s'|s,a) = log (T * K)(s'|s,a) - log K(0) <= 0, for `perceived` (perceived_size,); 0 where T predicts it exactly."""

    @abc.abstractmethod
    def relative_entropy(self) -> Array:
        """Environment entropy against the kernel, sum_i 1/2 log(1 + var_i / sigma_p^2); 0 where T is deterministic."""

    @abc.abstractmethod
    def sample(self, key: Array) -> Array:
        """A perceived next state, (perceived_size,)."""

    def log_prob(self, perceived: Array) -> Array:
        """log (T * K)(perceived | state, action)."""
        return self.relative_log_prob(perceived) + log_kernel_at_zero(self.width)


def log_kernel_at_zero(width: Array) -> Array:
    """log K(0) of a kernel with standard deviations `width` (perceived_size,)."""
    return -0.5 * jnp.sum(jnp.log(2 * math.pi * width**2))


@struct.dataclass
class Gaussian(PerceivedDensity):
    """A Gaussian T: (T * K)(s') = N(s'; mean, sd^2 + sigma_p^2). With sd = 0, T is deterministic."""

    mean: Array  # (perceived_size,)
    sd: Array  # () or (perceived_size,), of T alone
    width: Array  # (perceived_size,) sigma_p

    def relative_log_prob(self, perceived: Array) -> Array:
        ratio = self._variance_ratio()
        return -0.5 * jnp.sum(((perceived - self.mean) / self.width) ** 2 / (1 + ratio) + jnp.log1p(ratio))

    def relative_entropy(self) -> Array:
        return 0.5 * jnp.sum(jnp.log1p(self._variance_ratio()))

    def sample(self, key: Array) -> Array:
        spread = self.width * jnp.sqrt(1 + self._variance_ratio())
        return self.mean + spread * jax.random.normal(key, self.mean.shape, self.mean.dtype)

    def _variance_ratio(self) -> Array:
        """sd^2 / sigma_p^2, (perceived_size,)."""
        return (jnp.broadcast_to(self.sd, self.mean.shape) / self.width) ** 2


@struct.dataclass
class Mixture(PerceivedDensity):
    """A T of a few outcomes: (T * K)(s') = sum_k weights_k N(s'; outcomes_k, sigma_p^2)."""

    outcomes: Array  # (n, perceived_size)
    weights: Array  # (n,) probabilities, which sum to 1
    width: Array  # (perceived_size,) sigma_p

    def relative_log_prob(self, perceived: Array) -> Array:
        distances = (perceived[None] - self.outcomes) / self.width[None]
        terms = jnp.log(self.weights) - 0.5 * jnp.sum(distances**2, axis=1)
        return jnp.minimum(jax.nn.logsumexp(terms), 0.0)  # rounding must not make it positive

    def relative_entropy(self) -> Array:
        deviations = self.outcomes - (self.weights @ self.outcomes)[None]
        return 0.5 * jnp.sum(jnp.log1p(self.weights @ deviations**2 / self.width**2))

    def sample(self, key: Array) -> Array:
        key_outcome, key_see = jax.random.split(key)
        outcome = self.outcomes[jax.random.categorical(key_outcome, jnp.log(self.weights))]
        return outcome + self.width * jax.random.normal(key_see, outcome.shape, outcome.dtype)
