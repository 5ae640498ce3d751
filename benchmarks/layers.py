"""The ways in which a network's products can lie in memory, on all devices at once: why `peps_jax.learning.networks` has two."""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable
from typing import Any, NamedTuple

import equal_work
import jax
import jax.numpy as jnp
import numpy as np
import timing

from peps_jax.learning import networks

Network = Callable[[bool, tuple[networks.Layer, ...], jax.Array], jax.Array]


class Case(NamedTuple):
    """Networks side by side, and the rows of a minibatch of theirs."""

    members: int
    rows: int
    sizes: tuple[int, ...]
    normalised: bool = False
    own_rows: bool = False  # whether every member has rows of its own


WAYS: dict[str, Network] = {
    "rows": networks.in_rows,
    "rows, differentiated by JAX": networks.in_rows.fun,  # without the gradient that is written out
    "columns": networks.in_columns,
}


def cases() -> dict[str, Case]:
    """What a training of D1 has, as the text calls it, and the same with critics of 256 units."""
    config = equal_work.measured()
    environment = config.problem().environment
    inputs = networks.feature_size(environment.observation_size, environment.action_space)
    compared = config.surrogate_batch_size * 2 * config.segment_length
    return {
        "r̂": Case(config.ensemble_size, compared, (inputs, *config.model_hidden_sizes, 1), own_rows=True),
        "critics of 64 units": Case(2, config.batch_size, (inputs, 64, 64, 1), config.critic_normalisation),
        "critics of 256 units": Case(2, config.batch_size, (inputs, 256, 256, 1), config.critic_normalisation),
    }


def taken(case: Case) -> str:
    """The way that `networks.MLP` takes."""
    return next(title for title, way in WAYS.items() if way is networks.quicker(case.sizes[1:-1]))


def seconds_of(way: Network, case: Case, steps: int) -> float:
    """Of a step of gradient descent, through rows and weights that differ from device to device."""
    random = np.random.default_rng(0)
    draw = lambda *shape: random.normal(size=(jax.device_count(), *shape)).astype(np.float32)
    layers = tuple(
        networks.Layer(draw(case.members, size, units) / size**0.5, draw(case.members, units))
        for size, units in itertools.pairwise(case.sizes)
    )

    def loss(layers: tuple[networks.Layer, ...], rows: jax.Array) -> jax.Array:
        network = functools.partial(way, case.normalised)
        return 0.5 * jnp.mean(jax.vmap(network, in_axes=(0, 0 if case.own_rows else None))(layers, rows) ** 2)

    def descend(layers: tuple[networks.Layer, ...], rows: jax.Array) -> tuple[networks.Layer, ...]:
        step = lambda weights, gradient: weights - 1e-3 * gradient
        one = lambda _, layers: jax.tree.map(step, layers, jax.grad(loss)(layers, rows))
        return jax.lax.fori_loop(0, steps, one, layers)

    each = (case.members,) if case.own_rows else ()
    spread = timing.spread((layers, draw(*each, case.rows, case.sizes[0])))
    program, _ = timing.compiled(descend, *spread)
    return timing.seconds(program, *spread, repeats=5) / steps


def measure(quick: bool) -> dict[str, Any]:
    """Seconds of a gradient step in each way, and which is `taken`."""
    return {
        name: {"taken": taken(case)}
        | {title: seconds_of(way, case, 3 if quick else 6_400 // max(case.sizes)) for title, way in WAYS.items()}
        for name, case in cases().items()
    }
