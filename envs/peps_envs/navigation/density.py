"""The next position as perceived: a Gaussian slip that walls cut short, seen through the perceptual kernel, in closed form."""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array
from jax.scipy.special import log_ndtr, ndtr

from peps_envs.navigation.geometry import free_interval, walk
from peps_envs.navigation.parameters import NavigationParams
from peps_envs.perception import PerceivedDensity, log_kernel_at_zero

_TINY = 1e-30  # a probability of which the logarithm is still finite in float32


def _log_normal(value: Array, mean: Array, variance: Array) -> Array:
    return -0.5 * ((value - mean) ** 2 / variance + jnp.log(2 * math.pi * variance))


def _log_interval(value: Array, mean: Array, noise: Array, width: Array, low: Array, high: Array) -> Array:
    """log of the integral over x in [low, high] of N(x; mean, noise^2) N(value; x, width^2), exact for noise = 0 too."""
    variance = noise**2 + width**2
    posterior_mean = (mean * width**2 + value * noise**2) / variance
    posterior_sd = jnp.maximum(noise * width / jnp.sqrt(variance), 1e-6)
    upper, lower = (high - posterior_mean) / posterior_sd, (low - posterior_mean) / posterior_sd
    # the difference of two tails keeps its digits on the side where both are small
    upper, lower = jnp.where(lower > 0, -lower, upper), jnp.where(lower > 0, -upper, lower)
    mass = jnp.maximum(ndtr(upper) - ndtr(lower), _TINY)
    return _log_normal(value, mean, variance) + jnp.log(mass)


def _log_tail(distance_to_edge: Array, noise: Array) -> Array:
    """log P(noise * xi > distance_to_edge), exact for noise = 0 too, floored to stay finite."""
    # beyond 20 standard deviations lies the floor, and the derivative there would be 0 times infinity
    away = jnp.clip(distance_to_edge / jnp.maximum(noise, 1e-6), -20.0, 20.0)
    return jnp.maximum(log_ndtr(-away), math.log(_TINY))


def _log_stopped(value: Array, mean: Array, noise: Array, width: Array, low: Array, high: Array) -> Array:
    """log-density at `value` of clip(N(mean, noise^2), low, high) + N(0, width^2): the middle, and what both edges stop."""
    middle = _log_interval(value, mean, noise, width, low, high)
    at_low = _log_tail(mean - low, noise) + _log_normal(value, low, width**2)
    at_high = _log_tail(high - mean, noise) + _log_normal(value, high, width**2)
    return jnp.logaddexp(middle, jnp.logaddexp(at_low, at_high))


@struct.dataclass
class NavigationDensity(PerceivedDensity):
    """The next position as perceived. Exact: walls turn part of the Gaussian into atoms on their faces, which K then blurs."""

    position: Array  # (2,) before the step
    target: Array  # (2,) where the step leads before it slips
    noise: Array  # () standard deviation of the slip
    stuck: Array  # () probability of staying where it is
    params: NavigationParams

    @property
    def width(self) -> Array:
        return jnp.broadcast_to(self.params.perception_width, (2,))

    def _log_moving(self, perceived: Array) -> Array:
        """log-density, given that it moves. x is integrated piece by piece, because the limits of y change where a wall starts."""
        params, width, noise = self.params, self.params.perception_width, self.noise
        low, high = free_interval(self.target, 0, params)
        edges = jnp.sort(jnp.concatenate([params.walls[:, 0], params.walls[:, 2]]))
        edges = jnp.clip(jnp.concatenate([low[None], edges, high[None]]), low, high)

        def log_y(x: Array) -> Array:
            limits = free_interval(jnp.array([x, self.target[1]]), 1, params)
            return _log_stopped(perceived[1], self.target[1], noise, width, *limits)

        def piece(start: Array, end: Array) -> Array:
            log_x = _log_interval(perceived[0], self.target[0], noise, width, start, end)
            return jnp.where(end > start, log_x + log_y((start + end) / 2), -jnp.inf)

        pieces = jax.vmap(piece)(edges[:-1], edges[1:])
        at_low = _log_tail(self.target[0] - low, noise) + _log_normal(perceived[0], low, width**2) + log_y(low)
        at_high = _log_tail(high - self.target[0], noise) + _log_normal(perceived[0], high, width**2) + log_y(high)
        return jax.nn.logsumexp(jnp.concatenate([pieces, at_low[None], at_high[None]]))

    def log_prob(self, perceived: Array) -> Array:
        staying = jnp.sum(_log_normal(perceived, self.position, self.params.perception_width**2))
        return jnp.logaddexp(
            jnp.log(jnp.maximum(1 - self.stuck, _TINY)) + self._log_moving(perceived),
            jnp.log(jnp.maximum(self.stuck, _TINY)) + staying,
        )

    def relative_log_prob(self, perceived: Array) -> Array:
        return jnp.minimum(
            self.log_prob(perceived) - log_kernel_at_zero(self.width), 0.0
        )  # rounding must not make it positive

    def relative_entropy(self) -> Array:
        weights, positions = self.quadrature(7)
        mean = weights @ positions
        variance = weights @ (positions - mean[None]) ** 2
        return 0.5 * jnp.sum(jnp.log1p(variance / self.params.perception_width**2))

    def sample(self, key: Array) -> Array:
        key_move, key_see = jax.random.split(key)
        return self.move(key_move) + self.width * jax.random.normal(key_see, (2,), self.width.dtype)

    def move(self, key: Array) -> Array:
        """The true next position, before anybody looks at it."""
        key_noise, key_stuck = jax.random.split(key)
        slip = self.noise * jax.random.normal(key_noise, (2,), self.target.dtype)
        moved = walk(self.target, self.target + slip, self.params)
        return jnp.where(jax.random.uniform(key_stuck, dtype=self.stuck.dtype) < self.stuck, self.position, moved)

    def quadrature(self, points: int) -> tuple[Array, Array]:
        """Weights (n,) that sum to 1 and next positions (n, 2): E[f(s')] = sum_k weights[k] f(positions[k]), T alone."""
        nodes, node_weights = np.polynomial.hermite_e.hermegauss(points)
        node_weights = node_weights / node_weights.sum()
        offsets = jnp.asarray(np.stack(np.meshgrid(nodes, nodes), -1).reshape(-1, 2), self.target.dtype)
        moved = jax.vmap(lambda offset: walk(self.target, self.target + self.noise * offset, self.params))(offsets)
        weights = jnp.asarray(np.outer(node_weights, node_weights).reshape(-1), self.target.dtype) * (1 - self.stuck)
        return jnp.append(weights, self.stuck), jnp.concatenate([moved, self.position[None]])
