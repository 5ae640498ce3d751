"""Networks, and ensembles of them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import linen as nn
from jax import Array

import peps_envs


class MLP(nn.Module):
    """Dense layers with ReLU between them, and a linear output."""

    hidden_sizes: tuple[int, ...]
    output_size: int
    output_scale: float = 1.0

    @nn.compact
    def __call__(self, features: Array) -> Array:
        for size in self.hidden_sizes:
            features = nn.relu(nn.Dense(size)(features))
        init = nn.initializers.variance_scaling(self.output_scale, "fan_in", "truncated_normal")
        return nn.Dense(self.output_size, kernel_init=init)(features)


def init_ensemble(network: nn.Module, key: Array, members: int, input_size: int) -> Any:
    """Parameters of `members` independent networks, stacked along a leading axis."""
    return jax.vmap(network.init, in_axes=(0, None))(jax.random.split(key, members), jnp.zeros(input_size))


def apply_ensemble(network: nn.Module) -> Callable[[Any, Array], Array]:
    """(stacked parameters, features (..., n)) -> outputs (members, ..., output_size)."""
    return jax.vmap(network.apply, in_axes=(0, None))


def features_of(action_space: peps_envs.ActionSpace) -> Callable[[Array, Array], Array]:
    """(observation, action) -> what a network sees of both: a discrete action is one-hot."""

    def features(observation: Array, action: Array) -> Array:
        if isinstance(action_space, peps_envs.Discrete):
            action = jax.nn.one_hot(action, action_space.size)
        return jnp.concatenate([observation, action], axis=-1)

    return features


def feature_size(environment: peps_envs.Environment) -> int:
    """Length of `features_of`'s result."""
    return int(np.sum([environment.observation_size, environment.action_space.size]))
