"""What every method keeps to, whoever added it: it trains, acts, is evaluated, and learns r-hat only if it asks."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import peps_jax
from peps_jax import methods

EPISODES = 4


@pytest.mark.parametrize("method", methods.METHODS)
def test_it_trains_acts_and_is_evaluated(line, train, method):
    result = train(line.replace(method=method))
    for leaf in jax.tree.leaves((result.agents, result.knowledge, result.curves)):
        if jnp.issubdtype(leaf.dtype, jnp.floating):
            assert np.all(np.isfinite(leaf))
    assert len(result.agents) == len(methods.get(method).rewards)
    assert np.all(np.abs(result.act(jnp.zeros(1))) <= 1)
    evaluation = peps_jax.evaluate(result, EPISODES)
    assert evaluation.explicability.shape == (EPISODES,)
    assert np.all(np.isfinite(evaluation.explicability))


@pytest.mark.parametrize("method", methods.METHODS)
def test_who_asks_learns_from_answers(line, train, method):
    result, asks = train(line.replace(method=method)), methods.get(method).asks
    assert (result.surrogate is not None) == (result.preferences is not None) == asks
    assert ("surrogate_loss" in result.curves) == asks
    if asks:
        assert int(result.preferences.weight.sum()) == line.num_queries


@pytest.mark.parametrize("method", [name for name, method in methods.METHODS.items() if method.asks])
def test_without_answers_it_trains_all_the_same(line, train, method):
    result = train(line.replace(method=method, num_queries=0))
    assert int(result.preferences.weight.sum()) == 0
    for leaf in jax.tree.leaves((result.agents, result.knowledge, result.curves)):
        if jnp.issubdtype(leaf.dtype, jnp.floating):
            assert np.all(np.isfinite(leaf))


@pytest.mark.parametrize("method", methods.METHODS)
def test_lam_changes_something_if_it_is_used(line, train, method):
    one, two = (train(line.replace(method=method, lam=lam)).agents[0].critics for lam in (0.5, 2.4))
    moved = max(float(jnp.max(jnp.abs(a - b))) for a, b in zip(*map(jax.tree.leaves, (one, two)), strict=True))
    assert (moved > 1e-4) == methods.get(method).uses_lam


def test_a_taken_name_is_refused():
    with pytest.raises(ValueError, match="method 'sac' is registered already"):
        methods.register(methods.get("peps")._replace(name="sac"))
    assert methods.register(methods.get("sac")) is methods.get("sac")
