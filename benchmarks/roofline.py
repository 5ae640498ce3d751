"""The roofline: how fast this machine multiplies matrices of the shapes that SAC multiplies, on all devices at once.

An update of SAC, for observations of o and actions of a components, two layers of w units and a minibatch of b, multiplies

    policy:  forward at s' and at s, backward once         layers o-w-w-2a
    critics: forward at (s', a'), (s, a) and (s, pi(s)),   layers (o+a)-w-w-1, two of them
             backward to the weights once, to the action once

A layer i-j costs b i j multiply-adds forward, as many to its weights' gradient, and as many to its inputs' gradient.
"""

from __future__ import annotations

import collections
import itertools
from collections.abc import Callable
from typing import Any, NamedTuple

import equal_work
import jax
import numpy as np
import timing
from training import WIDTHS

from peps_jax import Config


class Product(NamedTuple):
    """A matrix product (m, k) x (k, n)."""

    m: int
    k: int
    n: int

    @property
    def work(self) -> int:
        """Multiply-adds."""
        return self.m * self.k * self.n


def forward(batch: int, sizes: tuple[int, ...]) -> list[Product]:
    return [Product(batch, i, j) for i, j in itertools.pairwise(sizes)]


def to_weights(batch: int, sizes: tuple[int, ...]) -> list[Product]:
    return [Product(i, batch, j) for i, j in itertools.pairwise(sizes)]


def to_inputs(batch: int, sizes: tuple[int, ...]) -> list[Product]:
    """Gradients of every layer's inputs, but for the first's."""
    return [Product(batch, j, i) for i, j in itertools.pairwise(sizes[1:])]


def products(config: Config) -> collections.Counter[Product]:
    """The products of one update, and how often each is made."""
    environment = config.problem().environment
    o, a, b = environment.observation_size, environment.action_space.size, config.batch_size
    policy, critic = (o, *config.hidden_sizes, 2 * a), (o + a, *config.hidden_sizes, 1)
    to_action = [*to_inputs(b, critic), Product(b, config.hidden_sizes[0], a)]
    made = collections.Counter(2 * forward(b, policy) + to_weights(b, policy) + to_inputs(b, policy))
    made.update(2 * (3 * forward(b, critic) + to_weights(b, critic) + to_inputs(b, critic) + to_action))
    return made


def seconds_of(made: collections.Counter[Product], batch: int, loops: int) -> dict[Product, float]:
    """Seconds of each product on each device, all of them at the same time.

    A chain of products leaves a device nothing else to do. (b, k) x (k, n) goes on with (b, n) x (n, k), and both count half;
    the gradient of weights (i, b) x (b, j) goes on with (b, i) x (i, j), which is known by then.
    """
    taken: dict[Product, float] = {}
    for product in sorted(made, key=lambda product: product.m != batch):
        m, k, n = product
        if product in taken:
            continue
        if m == batch:
            there = _orthogonal(k, n)
            back = there.T.copy()
            step, first = lambda x, there=there, back=back: (x @ there) @ back, _orthogonal(m, k)
            half = _seconds_a_step(step, first, loops) / 2
            taken |= {product: half, Product(m, n, k): half}
        else:
            inputs = _orthogonal(k, m)
            step, first = lambda y, inputs=inputs: inputs @ (inputs.T @ y), _orthogonal(k, n)
            taken[product] = max(_seconds_a_step(step, first, loops) - taken[Product(batch, m, n)], 0.0)
    return taken


def _orthogonal(rows: int, columns: int) -> np.ndarray:
    """Orthonormal in its rows or its columns, so that a chain of products neither grows nor fades."""
    size = max(rows, columns)
    square, _ = np.linalg.qr(np.random.default_rng(0).normal(size=(size, size)))
    return square[:rows, :columns].astype(np.float32)


def _seconds_a_step(step: Callable[[jax.Array], jax.Array], first: np.ndarray, loops: int) -> float:
    items = timing.spread(np.stack([first] * jax.device_count()))
    program, _ = timing.compiled(lambda x: jax.lax.fori_loop(0, loops, lambda _, x: step(x), x), items)
    return timing.seconds(program, items, repeats=5) / loops


def measure(quick: bool) -> dict[str, Any]:
    """For each width: multiply-adds of an update, their rate on all devices, and the steps a second that it would allow."""
    record = {}
    for width in WIDTHS:
        config = equal_work.measured("sac", width)
        made = products(config)
        loops = 5 if quick else 400 * 64 // width
        taken = seconds_of(made, config.batch_size, loops)
        work = sum(count * product.work for product, count in made.items())
        seconds = sum(count * taken[product] for product, count in made.items())
        square = Product(config.batch_size, width, width)
        updates_per_step = config.updates_per_round / config.steps_per_round
        record[str(width)] = {
            "multiply_adds": work,
            "seconds": seconds,
            "rate": jax.device_count() / seconds / updates_per_step,
            "multiply_adds_per_second": jax.device_count() * work / seconds,
            "square_multiply_adds_per_second": jax.device_count() * square.work / taken[square],
        }
    return record
