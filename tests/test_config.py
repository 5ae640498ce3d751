"""Settings: one clear line for each that makes no sense, and what is traced or static."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import Line, LineParams, settings

import peps_jax
from peps_jax import Config, grid
from peps_jax.config import Lengths, capacity
from peps_jax.train import check

WRONG = [
    ("query_strategy", "information", "information_gain"),
    ("level", "maximum", "max"),
    ("entropies", "relatif", "relative"),
    ("dynamics_batch_size", 0, "a whole number from 1 to"),
    ("num_envs", 0, "a whole number from 1 to"),
    ("num_envs", 2.5, "a whole number from 1 to"),
    ("total_steps", -1, "a whole number from 1 to"),
    ("batch_size", 0, "a whole number from 1 to"),
    ("ensemble_size", 0, "a whole number from 1 to"),
    ("num_queries", -1, "a whole number from 0 to"),
    ("prior", "nothing", "observed"),
    ("bound", 0.0, "above 0, or inf"),
    ("bound", float("nan"), "above 0, or inf"),
    ("uniform_answers", 1.0, "from 0 to below 1"),
    ("critic_normalisation", 1, "True or False"),
    ("warmup_steps", -5, "a whole number from 0 to"),
    ("unasked_steps", 121, "120"),
    ("updates_per_step", 0.0, "above 0"),
    ("hidden_sizes", (), "whole numbers from 1 to"),
    ("hidden_sizes", (8, 0), "whole numbers from 1 to"),
    ("model_hidden_sizes", (-1,), "whole numbers from 1 to"),
    ("segment_length", 11, "10"),
    ("watched_every", 3, "4"),
    ("min_segment_length", 6, "5"),
    ("candidates_per_query", 9, "10 or more"),
    ("lam", -0.5, "0 or more"),
    ("lam", float("nan"), "0 or more"),
    ("lam", "much", "0 or more"),
    ("lam", np.array([1.0, -1.0]), "0 or more"),
    ("temperature", -1.0, "0 or more"),
    ("rationality", -1.0, "0 or more"),
    ("gamma", 1.01, "from 0 to 1"),
    ("mistake_rate", -0.1, "from 0 to 1"),
    ("myopia", 2.0, "from 0 to 1"),
    ("learning_rate", 0.0, "above 0"),
    ("reward_scale", -0.1, "above 0"),
    ("seed", -1, "from 0 to"),
    ("seed", 2**31, "from 0 to"),
    ("seed", 1.5, "from 0 to"),
    ("seed", True, "from 0 to"),
    ("lam", float("inf"), "0 or more"),
    ("temperature", float("inf"), "0 or more"),
    ("saturation_penalty", float("inf"), "0 or more"),
    ("rationality", float("inf"), "0 or more"),
    ("learning_rate", float("inf"), "above 0"),
    ("reward_scale", float("inf"), "above 0"),
    ("updates_per_step", float("inf"), "above 0"),
    ("fade_share", float("inf"), "from 0 to 1"),
    ("skip_below", float("nan"), "a number"),
    ("skip_below", float("inf"), "a number"),
    ("num_envs", 2**31, "a whole number from 1 to"),
    ("num_envs", 2.5, "a whole number from 1 to"),
    ("num_envs", True, "a whole number from 1 to"),
    ("tune_temperature", 1, "True or False"),
    ("hidden_sizes", 8, "sizes"),
    ("lam", np.array([0.5, 1.0]), "jax.vmap"),
    ("seed", np.arange(3), "jax.vmap"),
]


def one_line(error):
    assert "\n" not in str(error.value)
    return str(error.value)


@pytest.mark.parametrize(("field", "value", "right"), WRONG)
def test_bad_values_get_one_line(tiny, field, value, right):
    with pytest.raises(ValueError, match=field) as error:
        peps_jax.train(tiny.replace(**{field: value}))
    line = one_line(error)
    assert line.startswith(field)
    assert isinstance(value, np.ndarray) or str(value) in line
    assert right in line


def test_unknown_names_get_the_nearest(tiny):
    with pytest.raises(ValueError, match=r"env 'nav-d11' is unknown: did you mean 'nav-d1'\?") as error:
        peps_jax.train(tiny.replace(env="nav-d11"))
    one_line(error)
    with pytest.raises(ValueError, match=r"method 'pebs' is unknown: did you mean 'peps'\?") as error:
        peps_jax.train(tiny.replace(method="pebs"))
    one_line(error)
    with pytest.raises(ValueError, match=r"belief 'biassed' is unknown: did you mean 'biased'\?") as error:
        tiny.replace(belief="biassed")
    one_line(error)


@pytest.mark.parametrize("missing", ["params", "belief"])
def test_an_environment_object_needs_params_and_belief(line, missing):
    with pytest.raises(ValueError, match=f"{missing} is None") as error:
        line.replace(**{missing: None}).problem()
    one_line(error)


def test_a_good_configuration_passes(tiny, line):
    for config in (tiny, line, Config(), Config(env="nav-d4", method="sac")):
        check(config)


def test_belief_by_name_and_by_value(tiny):
    problem = tiny.problem()
    assert float(problem.belief.pit_noise) > 0, "the task's first belief is the biased one"
    unbiased = tiny.replace(belief="unbiased").problem().belief
    jax.tree.map(np.testing.assert_array_equal, unbiased, problem.params)
    own = problem.params.replace(sand_gain=jnp.asarray(0.5))
    assert tiny.replace(belief=own).problem().belief is own
    assert problem.environment == tiny.problem().environment


def test_every_field_has_a_check_and_a_help_text():
    named = {"env", "method", "params", "belief", "lengths"}  # looked up, or compared with one another
    for field in dataclasses.fields(Config):
        assert field.metadata["help"], field.name
        assert field.metadata["group"], field.name
        assert (field.metadata["range"] is None) == (field.name in named), field.name


def test_every_field_reaches_a_part(tiny):
    """Other values of a field make other settings: none is read by nobody."""
    told = settings(tiny)
    same = lambda one, other: (
        jax.tree.structure(one) == jax.tree.structure(other)
        and all(np.array_equal(*pair) for pair in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True))
    )
    for field in dataclasses.fields(Config):
        if field.name in ("env", "method", "seed", "params", "belief", "lengths"):
            continue
        value = getattr(tiny, field.name)
        others = {
            bool: lambda value: not value,
            int: lambda value: 7 * value + 80,
            float: lambda value: 0.37 if not np.isfinite(value) else 0.5 * value + 0.13,
            tuple: lambda value: (*value, 3),
            str: lambda value, field=field: next(one for one in field.metadata["choices"] if one != value),
        }
        assert not same(settings(tiny.replace(**{field.name: others[type(value)](value)})), told), field.name


def test_rounds_cover_the_steps_and_the_queries(tiny):
    assert (tiny.steps_per_round, tiny.num_rounds, tiny.warmup_rounds) == (40, 4, 1)
    longer = tiny.replace(total_steps=161, warmup_steps=41, num_queries=21)
    assert (longer.num_rounds, longer.warmup_rounds) == (5, 2)
    assert longer.queries_per_round * longer.num_rounds >= 21


def test_static_fields_change_the_structure_and_traced_ones_do_not(line):
    structure = jax.tree.structure(line)
    assert structure == jax.tree.structure(line.replace(seed=3, lam=0.1, gamma=0.5, learning_rate=1.0, temperature=2.0))
    for change in (dict(num_envs=5), dict(method="sac"), dict(hidden_sizes=(9,)), dict(env=Line(horizon=9))):
        assert structure != jax.tree.structure(line.replace(**change))


def test_grid_gives_every_leaf_an_axis(line):
    configs = grid(line, seed=[0, 1, 2], lam=[0.0, 1.0, 2.0])
    assert all(leaf.shape[0] == 3 for leaf in jax.tree.leaves(configs))
    np.testing.assert_array_equal(configs.lam, [0.0, 1.0, 2.0])
    np.testing.assert_array_equal(configs.gamma, jnp.full(3, line.gamma))
    beliefs = LineParams(noise=jnp.array([0.1, 0.2]), slope=jnp.ones(2), width=jnp.full(2, 0.1))
    np.testing.assert_allclose(grid(line, belief=beliefs).belief.noise, [0.1, 0.2])


@pytest.mark.parametrize(
    ("leaves", "message"),
    [
        (dict(sed=[0]), "field 'sed' is unknown: did you mean 'seed'"),
        (dict(num_envs=[1, 2]), "num_envs is static"),
        (dict(seed=[0, 1], lam=[1.0]), r"seed, lam have lengths \[1, 2\]"),
        (dict(lam=[1.0, float("inf")]), "lam inf is out of range: choose 0 or more"),
        (dict(seed=[0, 2**31]), "seed 2147483648 is out of range"),
        (dict(lam=2.0), "lam 2.0 is no sequence"),
        (dict(), "leaves have lengths"),
    ],
)
def test_grid_says_what_is_wrong(line, leaves, message):
    with pytest.raises(ValueError, match=message) as error:
        grid(line, **leaves)
    one_line(error)


def test_lengths_have_to_fit_in():
    config = Config(total_steps=4_000, unasked_steps=2_000, num_queries=20).with_room()
    config.check()
    assert (config.total_steps, config.queries_per_round, config.num_queries) == (4_000, 4, 40)
    lengths = Lengths(num_rounds=10, warmup_rounds=12, unasked_rounds=5, num_queries=20)
    assert jax.tree.map(int, config.lengths) == lengths
    with pytest.raises(ValueError, match="lengths have num_rounds 11: there is room for 10; choose at most that"):
        config.replace(lengths=config.lengths.replace(num_rounds=11)).check()
    with pytest.raises(ValueError, match="lengths have num_queries 21: there is room for 20"):
        config.replace(lengths=config.lengths.replace(num_queries=21)).check()


def test_a_training_that_asks_nothing_needs_no_round_to_ask_in():
    Config(total_steps=4_000, unasked_steps=8_000, num_queries=0).check()


def test_room_is_a_round_number():
    assert [capacity(number) for number in (1, 5, 6, 7, 11, 50, 51, 99, 150, 151, 1_234, 10_001)] == [
        1, 5, 6, 8, 12, 50, 60, 100, 150, 200, 1_500, 12_000,
    ]  # fmt: skip
    assert all(capacity(capacity(number)) == capacity(number) >= number for number in range(1, 3_000))
