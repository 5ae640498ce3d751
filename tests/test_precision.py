"""Either precision: whatever JAX's default is, the library's own numbers are 32-bit, and every training runs.

`jax.eval_shape` traces a whole training: a scan whose carry changes its type fails there, as it would when compiled.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import TINY, Line, LineParams, Probe, ProbeParams

import peps_envs
import peps_jax
from peps_envs import Discrete
from peps_jax import Config, methods
from peps_jax.train import init, prepare, run_round

OWN = {
    "line": dict(env=Line(), params=LineParams(), belief=LineParams(noise=0.1)),
    "probe": dict(env=Probe(action_space=Discrete(3)), params=ProbeParams(), belief=ProbeParams(last=2.0)),
}


def config_of(env: str, method: str, **changes) -> Config:
    return Config(**(OWN.get(env) or dict(env=env)), **(TINY | changes | dict(method=method)))


def kinds(tree) -> set[str]:
    """The dtypes of `tree`'s leaves, random keys apart."""
    leaves = [leaf.dtype for leaf in jax.tree.leaves(tree)]
    return {str(kind) for kind in leaves if not jnp.issubdtype(kind, jax.dtypes.prng_key)}


@pytest.mark.parametrize("method", methods.METHODS)
@pytest.mark.parametrize("env", [*OWN, *peps_envs.names()])
def test_every_training_keeps_its_types_in_double_precision(env, method):
    with jax.enable_x64(True):
        config = config_of(env, method, level="quantile", tune_temperature=True, mistake_rate=0.1, myopia=0.9)

        def run(config):
            result = peps_jax.train(config)
            return result, peps_jax.evaluate(result, 2, stochastic=True)

        result, evaluation = jax.eval_shape(run, config)
        assert kinds((result.agents, result.knowledge, result.preferences)) <= {"float32", "int32", "uint32", "bool"}
        assert kinds((result.curves, evaluation)) <= {"float32", "bool"}
        state = jax.eval_shape(lambda config: init(prepare(config)), config)
        assert kinds(state.replay) <= {"float32", "int32", "bool"}


@pytest.mark.parametrize("env", [*OWN, "nav-d3", "highway-rain"])
def test_a_round_has_the_same_types_in_either_precision(env):
    """What a training carries is 32-bit; what an environment computes with is its own."""

    def types(x64):
        with jax.enable_x64(x64):
            training = prepare(config_of(env, "peps"))
            state, curves = jax.eval_shape(
                lambda training: run_round(init(training), jnp.asarray(0, jnp.int32), training), training
            )
            own = state.agents, state.knowledge, state.preferences, state.replay, state.actors.running, curves
            return [(leaf.shape, str(leaf.dtype)) for leaf in jax.tree.leaves(own)]

    assert types(False) == types(True)


@pytest.mark.parametrize("method", ["peps", "policy_shaping"])
def test_a_training_runs_in_double_precision(method):
    with jax.enable_x64(True):
        result = jax.jit(peps_jax.train)(config_of("line", method))
        assert kinds((result.agents, result.knowledge)) <= {"float32", "int32", "uint32"}
        learned = jax.tree.leaves((result.agents, result.curves))
        assert all(np.all(np.isfinite(leaf)) for leaf in learned)
        assert result.act(jnp.zeros(1)).dtype == jnp.float32
