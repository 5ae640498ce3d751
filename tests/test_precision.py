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
from peps_jax import Config, grid, methods
from peps_jax.preferences import data, teachers
from peps_jax.preferences.data import Answers, Segments
from peps_jax.train import init, prepare, run_round

OWN = {
    "line": dict(env=Line(), params=LineParams(), belief=LineParams(noise=0.1)),
    "probe": dict(env=Probe(action_space=Discrete(3)), params=ProbeParams(), belief=ProbeParams(last=2.0)),
}
# MJX takes seconds to be traced, and every method steps it alike
PAIRS = [
    (env, method)
    for env in [*OWN, *peps_envs.names()]
    for method in methods.METHODS
    if method == "peps" or not env.startswith("mjx-")
]


def config_of(env: str, method: str, **changes) -> Config:
    return Config(**(OWN.get(env) or dict(env=env)), **(TINY | changes | dict(method=method)))


def kinds(tree) -> set[str]:
    """The dtypes of `tree`'s leaves, random keys apart."""
    leaves = [leaf.dtype for leaf in jax.tree.leaves(tree)]
    return {str(kind) for kind in leaves if not jnp.issubdtype(kind, jax.dtypes.prng_key)}


def trained_and_evaluated(config):
    result = peps_jax.train(config)
    return result, peps_jax.evaluate(result, 2, stochastic=True)


@pytest.mark.parametrize(("env", "method"), PAIRS)
def test_every_training_keeps_its_types_in_double_precision(env, method):
    with jax.enable_x64(True):
        config = config_of(env, method, level="quantile", tune_temperature=True, mistake_rate=0.1, myopia=0.9)
        result, evaluation = jax.eval_shape(trained_and_evaluated, config)
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


@pytest.mark.parametrize(
    "changes",
    [
        dict(entropies="absolute"), dict(level="max"), dict(level="standard"), dict(tune_temperature=False),
        dict(query_strategy="disagreement"), dict(query_strategy="random"), dict(indifference=0.1, skip_below=-5.0),
        dict(lam=np.float64(2.0), gamma=np.float64(0.9), seed=np.int64(3), belief=LineParams(noise=np.float64(0.1))),
    ],
    ids=lambda changes: "-".join(changes),
)  # fmt: skip
@pytest.mark.parametrize("method", ["peps", "drlhp"])
def test_every_setting_keeps_its_types_in_double_precision(method, changes):
    with jax.enable_x64(True):
        config = config_of("line", method).replace(**changes)
        assert kinds(jax.eval_shape(lambda config: prepare(config).settings, config)) == {"float32", "int32"}
        result = jax.eval_shape(peps_jax.train, config)
        assert kinds((result.agents, result.knowledge, result.preferences)) <= {"float32", "int32", "uint32", "bool"}
        assert kinds(result.curves) == {"float32"}


def test_a_batch_of_trainings_keeps_its_types_in_double_precision():
    with jax.enable_x64(True):
        configs = grid(config_of("line", "peps"), seed=[0, 1], lam=[0.5, 2.0], gamma=np.array([0.9, 0.99]))
        assert "float64" in kinds(configs)
        result = jax.eval_shape(jax.vmap(peps_jax.train), configs)
        assert kinds((result.agents, result.knowledge)) <= {"float32", "int32", "uint32"}
        assert kinds(result.curves) == {"float32"}


@pytest.mark.parametrize(("env", "method"), [("line", "peps"), ("nav-d3", "sac")])
def test_a_training_runs_in_double_precision(env, method):
    with jax.enable_x64(True):
        config = config_of(env, method)
        result, evaluation = jax.jit(trained_and_evaluated)(config)
        assert kinds((result.agents, result.knowledge)) <= {"float32", "int32", "uint32"}
        assert kinds((result.curves, evaluation)) <= {"float32", "bool"}
        numbers = jax.tree.leaves((result.agents, result.curves, evaluation))
        assert all(np.all(np.isfinite(leaf)) for leaf in numbers)
        assert method == "sac" or int(result.preferences.weight.sum()) == config.num_queries
        observation = jnp.zeros(config.problem().environment.observation_size)
        assert observation.dtype == jnp.float64
        assert result.act(observation).dtype == jnp.float32


def test_people_and_recordings_teach_in_double_precision():
    """Who answers gives numpy's own types: 64-bit whole numbers and floats."""
    with jax.enable_x64(True):
        config, heard = config_of("line", "drlhp"), []

        def function(queries, index):
            heard.append(kinds((queries.number, queries.segments.observation, queries.segments.mask)))
            count = len(queries.number)
            return Answers(queries.number.astype(np.int64), np.full(count, 0.5), np.ones(count))

        result = peps_jax.train(config, teachers.host(function))
        assert heard == [{"int32", "float32", "bool"}] * config.num_rounds
        assert np.all(result.preferences.weight == 1)
        assert kinds((result.agents, result.knowledge)) <= {"float32", "int32", "uint32"}
        wide = jax.tree.map(
            lambda row: row.astype({"f": np.float64, "i": np.int64}.get(row.dtype.kind, row.dtype)),
            data.answered(result.preferences),
        )
        again = jax.eval_shape(lambda config: peps_jax.train(config, teachers.recorded(wide)), config)
        assert kinds((again.agents, again.knowledge, again.preferences)) <= {"float32", "int32", "uint32", "bool"}


def test_a_set_that_was_recorded_in_double_precision_is_32_bit():
    with jax.enable_x64(True):
        place = jnp.zeros((4, 2, 5, 1))
        for action, kind in ((place, "float32"), (jnp.zeros((4, 2, 5), jnp.int64), "int32")):
            segments = Segments(place, action, jnp.ones((4, 2, 5), bool), place[..., 0], place, place)
            assert kinds(segments) >= {"float64"}
            found = data.recording(segments, Answers(jnp.arange(4), jnp.ones(4), jnp.ones(4)))
            assert kinds(found) == {"float32", "int32", "bool"}
            assert kinds(found.action) == {kind}


def test_no_answer_is_filed_under_a_number_that_32_bits_wrap_to():
    found = data.checked(Answers(np.array([2**32 + 3, 3, -(2**32) + 2]), np.ones(3), np.ones(3)), 4)
    np.testing.assert_array_equal(found.number, [data.NOBODY, 3, data.NOBODY, data.NOBODY])


@pytest.mark.slow
@pytest.mark.parametrize(("env", "method"), [("highway-rain", "peps"), ("nav-d3", "policy_shaping")])
def test_no_training_makes_nan(env, method):
    """A user who looks for NaN in code of their own finds none of ours."""
    with jax.debug_nans(True):
        _, evaluation = jax.jit(trained_and_evaluated)(config_of(env, method, total_steps=80))
    assert np.all(np.isfinite(evaluation.explicability))
