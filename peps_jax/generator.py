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
    multiplier, increment, half = (jax.lax.full(a.shape, number, jnp.uint32) for number in (1664525, 1013904223, 16))
    words = [_multiply_add(increment, word, multiplier) for word in (a, b, c, d)]
    for _ in range(3):
        words = [jax.lax.bitwise_xor(word, jax.lax.shift_right_logical(word, half)) for word in _crossed(*words)]
    return tuple(words)


def _crossed(a: Array, b: Array, c: Array, d: Array) -> tuple[Array, Array, Array, Array]:
    a = _multiply_add(a, b, d)
    b = _multiply_add(b, c, a)
    c = _multiply_add(c, a, b)
    d = _multiply_add(d, b, c)
    return a, b, c, d


def _multiply_add(a: Array, b: Array, c: Array) -> Array:
    """a + b c, by `jax.lax`: operators take a tenth of a training's tracing."""
    return jax.lax.add(a, jax.lax.mul(b, c))


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


def integers(key: Array, shape: tuple[int, ...], first: Array | int, beyond: Array | int) -> Array:
    """Whole numbers from `first` on and below `beyond`, int32: those of `jax.random.randint`, whose two words one hash makes."""
    high, low = jax.vmap(lambda key: jax.random.bits(key, shape, jnp.uint32))(jax.random.split(key))
    count = (jnp.asarray(beyond, jnp.int32) - first).astype(jnp.uint32)
    half = jnp.uint32(2**16) % count
    return first + ((high % count * (half * half % count) + low % count) % count).astype(jnp.int32)


def wrap(words: Array) -> Array:
    """The keys whose words (..., 2) uint32 `jax.random.key_data` gave."""
    return jax.random.wrap_key_data(words, impl=_PCG4D)
