"""Random keys whose generator is cheap to compile: PCG4D, a hash of four words (Jarzynski and Olano 2020), of three rounds.

JAX's own Threefry is twenty rounds of cryptography, and each place that draws has all of them: a third of what XLA had to compile
of a training. The published hash (M. Jarzynski and M. Olano, "Hash functions for GPU rendering", JCGT 9(3), 2020) mixes twice;
where a key is fixed and a counter alone changes, its low bits are biased and bits of one word depend on one another. A third round,
and a shift after each, mends that: `tests/test_generator.py` has what was looked at.

A key is two words. All that follows from it is the hash of (key, counter, purpose), so that, as with Threefry, draws don't depend
on what else is drawn beside them, and a batch has the numbers of its single runs.
"""

from __future__ import annotations

import math
from typing import Any

import jax
import jax.extend.random
import jax.numpy as jnp
from jax import Array

_SEED, _SPLIT, _FOLD, _BITS = (number * 0x9E3779B9 & 0xFFFFFFFF for number in range(1, 5))  # purposes, far apart


def pcg4d(a: Array, b: Array, c: Array, d: Array) -> tuple[Array, Array, Array, Array]:
    """The hash of four words, each (...) uint32, as four others; a bijection."""
    words = [word * jnp.uint32(1664525) + jnp.uint32(1013904223) for word in (a, b, c, d)]
    for _ in range(3):
        words = [word ^ (word >> jnp.uint32(16)) for word in _crossed(*words)]
    return tuple(words)


def _crossed(a: Array, b: Array, c: Array, d: Array) -> tuple[Array, Array, Array, Array]:
    a = a + b * d
    b = b + c * a
    c = c + a * b
    d = d + b * c
    return a, b, c, d


def _hashed(key: Array, counter: Array, purpose: int) -> tuple[Array, Array, Array, Array]:
    """Four words for each of `counter` (...) uint32."""
    spread = lambda word: jnp.broadcast_to(word, counter.shape)
    return pcg4d(spread(key[0]), spread(key[1]), counter, spread(jnp.uint32(purpose)))


def _seeded(seed: Array) -> Array:
    wide = seed.dtype.itemsize > 4
    high = (seed >> 32).astype(jnp.uint32) if wide else jnp.zeros((), jnp.uint32)
    low = seed.astype(jnp.uint32)
    return jnp.stack(_hashed(jnp.stack([low, high]), jnp.zeros((), jnp.uint32), _SEED)[:2])


def _split(key: Array, shape: tuple[int, ...]) -> Array:
    counter = jax.lax.iota(jnp.uint32, math.prod(shape))
    return jnp.stack(_hashed(key, counter, _SPLIT)[:2], -1).reshape(*shape, 2)


def _folded(key: Array, number: Array) -> Array:
    return jnp.stack(_hashed(key, jnp.asarray(number).astype(jnp.uint32), _FOLD)[:2], -1)


def _bits(key: Array, width: int, shape: tuple[int, ...]) -> Array:
    number = math.prod(shape) * (2 if width == 64 else 1)  # words
    counter = jax.lax.iota(jnp.uint32, -(-number // 4))
    words = jnp.stack(_hashed(key, counter, _BITS), -1).reshape(-1)[:number]
    if width == 64:
        words = words.reshape(-1, 2).astype(jnp.uint64)
        words = words[:, 0] << jnp.uint64(32) | words[:, 1]
    return words.reshape(shape).astype(jnp.dtype(f"uint{width}"))  # fewer bits: the lowest


_PCG4D: Any = jax.extend.random.define_prng_impl(
    key_shape=(2,), seed=_seeded, split=_split, random_bits=_bits, fold_in=_folded, name="pcg4d", tag="pcg"
)


def key(seed: Array | int) -> Array:
    """The key of a training's seed, a whole number ()."""
    return jax.random.key(seed, impl=_PCG4D)


def wrap(words: Array) -> Array:
    """The keys whose words (..., 2) uint32 `jax.random.key_data` gave."""
    return jax.random.wrap_key_data(words, impl=_PCG4D)
