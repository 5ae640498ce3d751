"""The random generator: its hash against one in Python's integers, and what any generator has to do."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from peps_jax import generator

NUMBER = 1 << 18


def hash_in_integers(words):
    """Three rounds of PCG4D, a shift after each."""
    most = 2**32
    a, b, c, d = (word * 1664525 + 1013904223 for word in words)
    for _ in range(3):
        a = (a + b * d) % most
        b = (b + c * a) % most
        c = (c + a * b) % most
        d = (d + b * c) % most
        a, b, c, d = (word ^ (word >> 16) for word in (a, b, c, d))
    return [a, b, c, d]


def test_hash():
    words = np.random.default_rng(0).integers(0, 2**32, (4, 50), dtype=np.uint32)
    found = np.stack(generator.pcg4d(*map(jnp.asarray, words)))
    np.testing.assert_array_equal(found.T, [hash_in_integers(map(int, column)) for column in words.T])


@pytest.mark.parametrize(("first", "beyond"), [(0, 1), (0, 17), (3, 20_000), (-5, 2**20 + 7)])
def test_integers_are_those_of_jax(first, beyond):
    key, shape = generator.key(3), (4, 500)
    expected = jax.random.randint(key, shape, first, beyond, jnp.int32)
    found = generator.integers(key, shape, jnp.asarray(first), jnp.asarray(beyond))
    assert found.dtype == jnp.int32
    np.testing.assert_array_equal(found, expected)


def streams() -> dict[str, np.ndarray]:
    """Words (n,) as a training draws them: many from one key, and one from each of many keys."""
    key, number = generator.key(7), jnp.arange(NUMBER)
    one = jax.vmap(lambda key: jax.random.bits(key))
    return {
        "one key": jax.random.bits(key, (NUMBER,)),
        "split": one(jax.random.split(key, NUMBER)),
        "folded": one(jax.vmap(lambda number: jax.random.fold_in(key, number))(number)),
        "seeds": one(jax.vmap(generator.key)(number)),
        "rounds": one(
            jax.vmap(lambda number: jax.random.split(jax.random.fold_in(key, number // 4), 4)[number % 4])(number)
        ),
    }


STREAMS = streams()


@pytest.mark.parametrize("name", STREAMS)
def test_every_bit_is_fair_and_independent(name):
    words = np.asarray(STREAMS[name])
    bits = (words[:, None] >> np.arange(32, dtype=np.uint32) & 1) - 0.5
    assert np.abs(bits.mean(0)).max() < 5 * 0.5 / np.sqrt(NUMBER)
    for lag in (0, 1, 2, 4, 5):  # 4: the same word of the next hash
        together = 4 * bits[: NUMBER - lag].T @ bits[lag:] / NUMBER
        assert np.abs(together - (lag == 0) * np.eye(32)).max() < 5.5 / np.sqrt(NUMBER), lag


@pytest.mark.parametrize("name", STREAMS)
@pytest.mark.parametrize("shift", [0, 8, 16])
def test_half_words_are_uniform(name, shift):
    counts = np.bincount(np.asarray(STREAMS[name]) >> shift & 0xFFFF, minlength=1 << 16)
    expected = NUMBER / (1 << 16)
    z = (np.sum((counts - expected) ** 2 / expected) - counts.size) / np.sqrt(2 * counts.size)
    assert abs(z) < 5


def test_draws_of_one_width_and_another():
    key = generator.key(3)
    assert jax.random.bits(key, (5,), "uint8").dtype == np.uint8
    for shape in ((), (3,), (2, 5), (0,)):
        assert jax.random.uniform(key, shape).shape == shape
    with jax.enable_x64(True):
        wide = np.asarray(jax.random.uniform(key, (10_000,), jnp.float64))
        assert abs(wide.mean() - 0.5) < 0.02
        assert len(np.unique(wide)) == 10_000
        # one seed is one key, whatever its type
        same = [jax.random.key_data(generator.key(kind(5))) for kind in (jnp.int32, jnp.int64, jnp.uint32)]
        np.testing.assert_array_equal(same[0], same[1])
        np.testing.assert_array_equal(same[0], same[2])


def test_purposes_differ():
    key = generator.key(0)
    words = {
        "key": jax.random.key_data(key),
        "split": jax.random.key_data(jax.random.split(key)[0]),
        "folded": jax.random.key_data(jax.random.fold_in(key, 0)),
        "bits": jax.random.bits(key, (2,)),
    }
    assert len({tuple(np.asarray(row).tolist()) for row in words.values()}) == len(words)


def test_a_batch_has_the_numbers_of_its_single_keys():
    keys = jax.vmap(generator.key)(jnp.arange(5))
    together = jax.vmap(lambda key: jax.random.normal(key, (3, 2)))(keys)
    np.testing.assert_array_equal(together, [jax.random.normal(generator.key(seed), (3, 2)) for seed in range(5)])


def test_keys_from_their_words():
    key = jax.random.split(generator.key(1), 3)
    again = generator.wrap(jax.random.key_data(key))
    np.testing.assert_array_equal(jax.random.key_data(again), jax.random.key_data(key))
    assert again.dtype == key.dtype
