"""Networks, and ensembles of them."""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from flax import linen as nn
from jax import Array

import peps_envs


class MLP(nn.Module):
    """Dense layers with ReLU between them, and a linear output.

    `normalised` divides each hidden layer's sums by their root mean square before ReLU (Zhang and Sennrich 2019, without gains).
    """

    hidden_sizes: tuple[int, ...]
    output_size: int
    output_scale: float = 1.0
    normalised: bool = False

    @nn.compact
    def __call__(self, features: Array) -> Array:
        last = nn.initializers.variance_scaling(self.output_scale, "fan_in", "truncated_normal")
        inits = [nn.initializers.lecun_normal()] * len(self.hidden_sizes) + [last]
        sizes = itertools.pairwise((features.shape[-1], *self.hidden_sizes, self.output_size))
        layers = tuple(
            Weights(*size, init, name=f"Dense_{place}")()
            for place, (size, init) in enumerate(zip(sizes, inits, strict=True))
        )
        if self.is_initializing():  # whose output nobody looks at
            return jnp.zeros(self.output_size, jnp.float32)
        outputs = quicker(self.hidden_sizes)(self.normalised, layers, features.reshape(-1, features.shape[-1]))
        return outputs.reshape(*features.shape[:-1], self.output_size)


class Weights(nn.Module):
    """A layer's kernel (inputs, outputs) and bias (outputs,)."""

    inputs: int
    outputs: int
    init: nn.initializers.Initializer

    @nn.compact
    def __call__(self) -> Layer:
        if not self.is_initializing():  # Flax's `param` would trace the drawing once more, to compare shapes
            return Layer(self.get_variable("params", "kernel"), self.get_variable("params", "bias"))
        return Layer(
            self.param("kernel", self.init, (self.inputs, self.outputs), jnp.float32),
            self.param("bias", nn.initializers.zeros, (self.outputs,), jnp.float32),
        )


class Layer(NamedTuple):
    """What a layer multiplies by and adds."""

    kernel: Array
    bias: Array


# --- dense layers -----------------------------------------------------------------------------------------------------------
#
# A network is little more than its products, and how fast XLA makes them on a CPU depends on how their arguments lie. Narrow
# layers are twice as fast on columns as on rows; wider ones are quicker on rows, but for a kernel's gradient, x^T g for inputs
# x (rows, n) and gradients g (rows, m). Differentiated by JAX, it reads x transposed, at half the speed: a sixth of an update of
# SAC. So that gradient is written out, and takes x^T from where it costs less. Barriers keep XLA from putting transpositions back
# into the products.

NARROW_UNITS = 32  # a hidden layer's at most for which columns are quicker
NARROW_OUTPUTS = 8  # outputs at most for which a product with g^T, transposed afterwards, is quicker
LEAST_SQUARE = 1e-5  # keeps a normalisation from dividing by 0
FEWER = 4  # times as many units as features, from which on the first layer is cheaper computed again than transposed

_kept = jax.lax.optimization_barrier


def quicker(hidden_sizes: tuple[int, ...]) -> Callable[[bool, tuple[Layer, ...], Array], Array]:
    """Of `in_columns` and `in_rows`, which are one function."""
    return in_columns if max(hidden_sizes, default=0) <= NARROW_UNITS else in_rows


def in_columns(normalised: bool, layers: tuple[Layer, ...], rows: Array) -> Array:
    """Dense layers with ReLU between them: rows (r, n) -> (r, m)."""
    columns = rows.T
    for place, layer in enumerate(layers):
        if place:
            columns = nn.relu(_standardized(columns.T)[0].T if normalised else columns)
        columns = _kept(layer.kernel.T) @ columns + layer.bias[:, None]
    return columns.T


def _standardized(sums: Array) -> tuple[Array, Array]:
    """`sums` (r, n) over their root mean square, row by row, and what it multiplied by, (r, 1)."""
    scale = jax.lax.rsqrt(_mean(sums**2) + LEAST_SQUARE)
    return sums * scale, scale


def _mean(rows: Array) -> Array:
    """(r, 1) from (r, n), as a product: XLA's sum over so few columns takes twice as long."""
    units = rows.shape[-1]
    return rows @ jnp.full((units, 1), 1 / units, rows.dtype)


def _applied(layer: Layer, rows: Array) -> Array:
    return rows @ layer.kernel + layer.bias[None]


@functools.partial(jax.custom_vjp, nondiff_argnums=(0,))
def in_rows(normalised: bool, layers: tuple[Layer, ...], rows: Array) -> Array:
    """As `in_columns`."""
    return _forward(normalised, layers, rows)[0]


class _Known(NamedTuple):
    """What the gradient is made of."""

    layers: tuple[Layer, ...]
    given: list[Array]  # what every layer is given
    standardized: list[tuple[Array, Array]]  # of every hidden layer that is normalised


def _forward(normalised: bool, layers: tuple[Layer, ...], rows: Array) -> tuple[Array, _Known]:
    given, standardized = [rows], []
    for layer in layers[:-1]:
        sums = _applied(layer, given[-1])
        if normalised:
            standardized.append(_standardized(sums))
            sums = standardized[-1][0]
        given.append(nn.relu(sums))
    return _applied(layers[-1], given[-1]), _Known(layers, given, standardized)


def _backward(normalised: bool, known: _Known, gradient: Array) -> tuple[tuple[Layer, ...], Array]:
    layers, given, standardized = known
    gradients: list[Layer] = []
    for place in reversed(range(len(layers))):
        gradients.insert(0, Layer(_kernel_gradient(place, known, gradient), jnp.sum(gradient, 0)))
        gradient = gradient @ layers[place].kernel.T
        if place:
            gradient = jnp.where(given[place] > 0, gradient, 0.0)
            if normalised:
                gradient = _through_standardizing(gradient, *standardized[place - 1])
    return tuple(gradients), gradient


def _through_standardizing(gradient: Array, outputs: Array, scale: Array) -> Array:
    return scale * (gradient - outputs * _mean(gradient * outputs))


def _kernel_gradient(place: int, known: _Known, gradient: Array) -> Array:
    """given[place]^T gradient."""
    layers, given, standardized = known
    inputs, features = given[place], given[0]
    if place == 0:
        return _kept(inputs.T) @ gradient
    if gradient.shape[-1] <= NARROW_OUTPUTS:
        return _kept(_kept(gradient.T) @ inputs).T
    if place == 1 and not standardized and FEWER * features.shape[-1] <= inputs.shape[-1]:
        first = layers[0]
        return nn.relu(_kept(first.kernel.T) @ features.T + first.bias[:, None]) @ gradient
    return inputs.T @ gradient


in_rows.defvjp(_forward, _backward)


# --- ensembles ------------------------------------------------------------------------------------------------------------


def init_ensemble(network: nn.Module, key: Array, members: int, input_size: int) -> Any:
    """Parameters of `members` independent networks, stacked along a leading axis."""
    return jax.vmap(network.init, in_axes=(0, None))(jax.random.split(key, members), jnp.zeros(input_size, jnp.float32))


def apply_ensemble(network: nn.Module) -> Callable[[Any, Array], Array]:
    """(stacked parameters, features (..., n)) -> outputs (members, ..., output_size)."""
    return jax.vmap(network.apply, in_axes=(0, None))


def fit_ensemble(
    loss: Callable[..., tuple[Array, Any]],
    optimizer: optax.GradientTransformation,
    params: Any,
    optimizer_state: Any,
    *minibatches: Any,
) -> tuple[Any, Any, tuple[Array, Any]]:
    """A gradient step of every member on each of its own minibatches.

    Args:
      loss: (one member's parameters, *a minibatch) -> (), and other figures () of it.
      minibatches: pytrees with leading axes (updates, members).

    Returns:
      parameters, the optimizer's state, and the loss and figures of every update and member, (updates, members).
    """

    def update(state: tuple[Any, Any], minibatch: tuple[Any, ...]) -> tuple[tuple[Any, Any], tuple[Array, Any]]:
        params, optimizer_state = state
        losses, grads = jax.vmap(jax.value_and_grad(loss, has_aux=True))(params, *minibatch)
        updates, optimizer_state = optimizer.update(grads, optimizer_state, params)
        return (optax.apply_updates(params, updates), optimizer_state), losses

    (params, optimizer_state), losses = jax.lax.scan(update, (params, optimizer_state), minibatches)
    return params, optimizer_state, losses


def features_of(action_space: peps_envs.ActionSpace) -> Callable[[Array, Array], Array]:
    """(observation, action) -> what a network sees of both: a discrete action is one-hot."""

    def features(observation: Array, action: Array) -> Array:
        if isinstance(action_space, peps_envs.Discrete):
            action = jax.nn.one_hot(action, action_space.size, dtype=observation.dtype)
        return jnp.concatenate([observation, action], axis=-1)

    return features


def feature_size(observation_size: int, action_space: peps_envs.ActionSpace) -> int:
    """Length of `features_of`'s result."""
    return observation_size + action_space.size
