"""The next position as perceived: a Gaussian slip that walls cut short, seen through the perceptual kernel, in closed form."""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array
from jax.scipy.special import erfc

from peps_envs.navigation.geometry import free_interval, walk
from peps_envs.navigation.parameters import NavigationParams
from peps_envs.perception import PerceivedDensity, log_kernel_at_zero

_TINY = 1e-30  # a probability of which the logarithm is still finite in float32


def _log_normal(value: Array, mean: Array, variance: Array) -> Array:
    return -0.5 * ((value - mean) ** 2 / variance + jnp.log(2 * math.pi * variance))


def _below(standardized: Array) -> Array:
    """P(xi < standardized), with all its digits where that is small."""
    return 0.5 * erfc(-standardized / math.sqrt(2))


def _log_interval(value: Array, mean: Array, noise: Array, width: Array, low: Array, high: Array) -> Array:
    """log of the integral over x in [low, high] of N(x; mean, noise^2) N(value; x, width^2), exact for noise = 0 too."""
    variance = noise**2 + width**2
    posterior_mean = (mean * width**2 + value * noise**2) / variance
    posterior_sd = jnp.maximum(noise * width / jnp.sqrt(variance), 1e-6)
    upper, lower = (high - posterior_mean) / posterior_sd, (low - posterior_mean) / posterior_sd
    # the difference of two tails keeps its digits on the side where both are small
    upper, lower = jnp.where(lower > 0, -lower, upper), jnp.where(lower > 0, -upper, lower)
    shares = _below(jnp.stack([upper, lower]))
    return _log_normal(value, mean, variance) + jnp.log(jnp.maximum(shares[0] - shares[1], _TINY))


def _log_edge(value: Array, edge: Array, beyond: Array, noise: Array, width: Array) -> Array:
    """log-density at `value` of what an edge stops: of a slip noise * xi whatever leads `beyond` it, exact for noise = 0 too."""
    stopped = jnp.maximum(_below(-beyond / jnp.maximum(noise, 1e-6)), _TINY)
    return jnp.log(stopped) + _log_normal(value, edge, width**2)


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
        """log-density, given that it moves. x is integrated piece by piece, because the limits of y change where a wall starts.

        Of x in a piece and y between its limits there is a density, and what an edge stops, of x or of y, is an atom on it. Each
        formula stands here once, for all places: programs hold this density many times.
        """
        params, width, noise = self.params, self.params.perception_width, self.noise
        low, high = free_interval(self.target, 0, params)
        # what was sorted is read where it is needed; low and high as they are would be computed again at every place
        edges = jnp.concatenate([low[None], params.walls[:, 0], params.walls[:, 2], high[None]])
        edges = jnp.sort(jnp.clip(edges, low, high))
        start, end, low, high = edges[:-1], edges[1:], edges[0], edges[-1]
        columns = jnp.concatenate([(start + end) / 2, jnp.stack([low, high])])  # x of each piece, and of both atoms
        limits = jax.vmap(lambda x: jnp.stack(free_interval(jnp.stack([x, self.target[1]]), 1, params)))(columns)

        both = lambda pair, x, y: jnp.concatenate([jnp.full_like(x, pair[0]), jnp.full_like(y, pair[1])])
        inner_low, inner_high = jnp.concatenate([start, limits[:, 0]]), jnp.concatenate([end, limits[:, 1]])
        value, mean = (both(pair, start, columns) for pair in (perceived, self.target))
        inner = _log_interval(value, mean, noise, width, inner_low, inner_high)

        x_edges, y_edges = jnp.stack([low, high]), limits.reshape(-1)
        edge, sign = jnp.concatenate([x_edges, y_edges]), np.tile([-1.0, 1.0], 1 + columns.shape[0]).astype(width.dtype)
        value, mean = (both(pair, x_edges, y_edges) for pair in (perceived, self.target))
        stopped = _log_edge(value, edge, sign * (edge - mean), noise, width)

        log_x = jnp.concatenate([jnp.where(end > start, inner[: start.shape[0]], -jnp.inf), stopped[:2]])
        y = jnp.concatenate([inner[start.shape[0] :, None], stopped[2:].reshape(-1, 2)], 1)
        return jax.nn.logsumexp(log_x[:, None] + y)

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
