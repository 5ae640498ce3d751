"""Preferences as data, and the three teachers behind one door."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import Point

import peps_jax
from peps_envs import Box, Discrete
from peps_jax.preferences import data, teachers
from peps_jax.preferences.data import Answers, Segments

STEPS = 3


def pairs(number, first=0.0, steps=STEPS):
    """Pairs whose observations say which they are."""
    place = first + jnp.arange(number, dtype=jnp.float32)[:, None, None, None] * jnp.ones((1, 2, steps, 1))
    point = Point(place, jnp.zeros(place.shape[:-1], jnp.int32))
    return Segments(place, place / 10, jnp.ones(place.shape[:-1], bool), place[..., 0] / 100, point, point)


@functools.partial(jax.jit, static_argnames="room")
def ask(preferences, segments, index, unasked=0, room=12, budget=10):
    return data.ask(preferences, segments, index, unasked, room, jnp.asarray(budget))


def asked(rounds=3, recorded=None, unasked=0):
    """A set after so many rounds of four queries, ten in all, and the queries of each."""
    preferences = data.empty(12, STEPS, 1, Box(1))
    if recorded is not None:
        preferences = data.joined(recorded, preferences)
    queries = []
    for index in range(rounds):
        preferences, now = ask(preferences, pairs(4, 4.0 * index), jnp.asarray(index), jnp.asarray(unasked))
        queries.append(now)
    return preferences, queries


def said(number, preferred, weight=None):
    weight = np.ones(len(number)) if weight is None else weight
    return Answers(jnp.asarray(number), jnp.asarray(preferred, jnp.float32), jnp.asarray(weight, jnp.float32))


def filed(preferences, answers, now=0):
    return jax.jit(data.file)(preferences, answers, jnp.asarray(now))


# --- the set --------------------------------------------------------------------------------------------------------------


def test_queries_have_numbers_and_what_is_beyond_the_budget_has_none():
    preferences, queries = asked()
    np.testing.assert_array_equal(preferences.number, [*range(10), data.NOBODY, data.NOBODY])
    np.testing.assert_array_equal(queries[2].number, [8, 9, data.NOBODY, data.NOBODY])
    np.testing.assert_array_equal(preferences.observation[:, 0, 0, 0], [*range(10), 0, 0])
    assert not np.any(preferences.weight)


def test_what_is_asked_begins_after_the_rounds_without_queries():
    preferences, queries = asked(unasked=1)
    assert [now.number.tolist() for now in queries] == [[data.NOBODY] * 4, [0, 1, 2, 3], [4, 5, 6, 7]]
    np.testing.assert_array_equal(preferences.number, [*[data.NOBODY] * 4, *range(8)])
    np.testing.assert_array_equal(preferences.observation[:, 0, 0, 0], [0, 0, 0, 0, *range(4, 12)])
    found = filed(preferences, said([data.NOBODY, 0, 5], [1.0, 1.0, 1.0]))
    np.testing.assert_array_equal(np.flatnonzero(found.weight), [4, 9])


def test_where_nothing_may_be_asked_a_recording_stays_as_it_is():
    recorded = data.before(
        data.recording(pairs(3), said([0, 1, 2], [1.0, 0.0, 1.0])), data.empty(12, STEPS, 1, Box(1)), False
    )
    assert recorded.number.shape == (12,)
    preferences, queries = ask(recorded, pairs(4), jnp.asarray(0), budget=0)
    jax.tree.map(np.testing.assert_array_equal, preferences, recorded)
    assert np.all(queries.number == data.NOBODY)


def test_answers_are_filed_under_their_numbers_in_any_order_and_never_under_none():
    preferences, _ = asked()
    found = filed(preferences, said([7, 2, data.NOBODY, 99], [1.0, 0.0, 1.0, 1.0]))
    np.testing.assert_array_equal(np.flatnonzero(found.weight), [2, 7])
    np.testing.assert_array_equal(found.preferred[jnp.array([2, 7])], [0.0, 1.0])


def test_repeated_answers_are_weighed_by_how_many_gave_them():
    preferences, _ = asked()
    found = filed(preferences, said([3, 3, 3], [1.0, 0.0, 1.0]))
    found = filed(found, said([3], [0.0], [2.0]))
    np.testing.assert_allclose([found.weight[3], found.preferred[3]], [5.0, 2 / 5])
    skipped = filed(found, said([3, 4], [1.0, 1.0], [0.0, 0.0]))
    jax.tree.map(np.testing.assert_array_equal, skipped, found)


def test_an_answer_is_known_from_the_round_on_in_which_it_came():
    preferences, _ = asked()
    found = filed(filed(preferences, said([0], [1.0]), now=1), said([5, 0], [1.0, 1.0]), now=4)
    known = lambda now: np.flatnonzero(data.known(found, jnp.asarray(now)).weight)
    assert [known(now).tolist() for now in (0, 1, 3, 4)] == [[], [0], [0], [0, 5]]
    np.testing.assert_array_equal(np.flatnonzero(data.known(data.at_once(found), jnp.asarray(0)).weight), [0, 5])


def test_under_vmap_a_write_is_one_slice():
    """At a batched place it would be a scatter of rows. JAX writes a slice as a scatter too, of one window of all dimensions."""

    def program(preferences, segments, number):
        preferences, queries = data.ask(preferences, segments, jnp.asarray(1), jnp.asarray(0), 12, jnp.asarray(10))
        answers = Answers(queries.number + number, jnp.ones(4), jnp.ones(4))
        return data.known(data.file(preferences, answers, jnp.asarray(1)), jnp.asarray(2))

    batch = jax.tree.map(lambda row: jnp.stack([row, row]), (data.empty(12, STEPS, 1, Box(1)), pairs(4)))
    equations = jax.make_jaxpr(jax.vmap(program))(*batch, jnp.arange(2)).eqns
    writes = [equation for equation in equations if "scatter" in equation.primitive.name]
    for equation in writes:
        window = equation.params["dimension_numbers"].update_window_dims
        assert len(window) == equation.invars[0].aval.ndim, "all of the slice at once"
        assert equation.invars[1].aval.ndim == 1, "one place for all"
    assert not any(equation.primitive.name == "dynamic_update_slice" for equation in equations)
    assert len(writes) == 8, "a field each"


def test_new_queries_stand_behind_recorded_ones_and_have_higher_numbers():
    first, _ = asked()
    recorded = data.answered(filed(first, said([1, 6], [1.0, 0.0])))
    np.testing.assert_array_equal(recorded.number, [1, 6])
    preferences, queries = asked(rounds=1, recorded=recorded)
    np.testing.assert_array_equal(queries[0].number, [7, 8, 9, 10])
    np.testing.assert_array_equal(preferences.number[:6], [1, 6, 7, 8, 9, 10])
    np.testing.assert_array_equal(preferences.weight[:3], [1, 1, 0])


def test_segments_of_other_lengths_fit_together():
    recorded = data.recording(pairs(2, steps=5), said([0, 1], [1.0, 0.0]))
    preferences, queries = asked(rounds=1, recorded=recorded)
    assert preferences.mask.shape == (14, 2, 5)
    np.testing.assert_array_equal(preferences.mask[2].sum(-1), [STEPS, STEPS])
    assert queries[0].segments.mask.shape == (4, 2, STEPS)


# --- files ----------------------------------------------------------------------------------------------------------------


def test_a_set_is_saved_and_loaded(tmp_path):
    preferences, _ = asked()
    preferences = filed(preferences, said([7, 2], [1.0, 0.5], [1.0, 3.0]), now=2)
    data.save(tmp_path / "answers.npz", preferences)
    loaded = data.load(tmp_path / "answers.npz")
    jax.tree.map(np.testing.assert_array_equal, loaded, data.answered(preferences))
    np.testing.assert_array_equal(loaded.number, [2, 7])
    np.testing.assert_array_equal(loaded.weight, [3, 1])


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04 but damaged", b"no zip at all"])
def test_another_file_is_refused_in_one_line(content, tmp_path):
    (tmp_path / "answers.npz").write_bytes(content)
    with pytest.raises(ValueError, match=r"^preferences '[^\n]*answers.npz'[^\n]*$"):
        data.load(tmp_path / "answers.npz")
    with pytest.raises(ValueError, match=r"none.npz' can't be read: No such file"):
        data.load(tmp_path / "none.npz")


def test_preferences_of_another_environment_are_refused(line):
    recorded = data.recording(pairs(3), said([0, 1, 2], [1.0, 0.0, 1.0]))
    data.check(recorded, 1, Box(1))
    for size, space in ((2, Box(1)), (1, Discrete(3))):
        with pytest.raises(ValueError, match="environment's are"):
            data.check(recorded, size, space)
    with pytest.raises(ValueError, match="given until round 9, and this training has 4 rounds"):
        peps_jax.train(line, teachers.recorded(recorded.replace(since=recorded.since + 9)))
    with pytest.raises(ValueError, match="empty"):
        peps_jax.train(line, teachers.recorded(data.empty(0, STEPS, 1, Box(1))))


@pytest.mark.parametrize(
    ("answers", "message"),
    [
        (Answers(np.array([0, 1]), np.array([1.0]), np.array([1.0])), "shapes"),
        (Answers(np.array([0.5]), np.array([1.0]), np.array([1.0])), "whole numbers"),
        (Answers(np.array([0]), np.array([1.5]), np.array([1.0])), "preferred 1.5: give numbers from 0 to 1"),
        (Answers(np.array([0]), np.array([1.0]), np.array([-1.0])), "weight -1.0"),
        (Answers(np.array([0]), np.array([np.nan]), np.array([1.0])), "preferred nan"),
    ],
)
def test_answers_from_outside_are_checked(answers, message):
    with pytest.raises(ValueError, match=message):
        data.checked(answers, 4)


# --- teachers -------------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def taught(line):
    """A training by the synthetic human."""
    return peps_jax.train(line.replace(mistake_rate=0.1))


def same_bits(one, other):
    jax.tree.map(np.testing.assert_array_equal, one, other)


def test_a_recording_teaches_bit_by_bit_what_its_teacher_did(line, taught, tmp_path):
    data.save(tmp_path / "answers.npz", taught.preferences)
    teacher = teachers.recorded(data.load(tmp_path / "answers.npz"))
    again = peps_jax.train(line.replace(mistake_rate=0.1), teacher)
    same_bits(again.agents, taught.agents)
    same_bits(again.knowledge, taught.knowledge)
    same_bits(again.curves, taught.curves)
    other = peps_jax.train(line.replace(seed=5), teacher)
    assert not np.allclose(other.curves["surrogate_loss"], taught.curves["surrogate_loss"])


def test_a_recording_is_mixed_with_new_answers(line, taught):
    recorded = data.at_once(data.answered(taught.preferences))
    teacher = teachers.recorded(recorded, then=teachers.SYNTHETIC)
    result = peps_jax.train(line.replace(seed=1), teacher)
    numbers = np.asarray(result.preferences.number)
    np.testing.assert_array_equal(numbers, np.arange(2 * line.num_queries))
    assert np.all(result.preferences.weight == 1)
    np.testing.assert_array_equal(result.preferences.preferred[: line.num_queries], recorded.preferred)


def test_a_teacher_on_the_host_is_called_between_the_halves(line, taught):
    """Who says what the synthetic human said, some of it late, and then what it has not been asked."""
    given = jax.tree.map(np.asarray, taught.preferences)
    heard, held_back = [], []

    def function(queries, index):
        heard.append((index, queries.number.copy()))
        assert isinstance(queries.segments.observation, np.ndarray)
        if index == 0:
            held_back.extend(queries.number[:2])
            numbers = queries.number[2:]
        else:
            numbers = np.concatenate([queries.number, np.asarray(held_back, np.int32)])
            held_back.clear()
        return Answers(numbers, given.preferred[numbers], np.ones(len(numbers)))

    result = peps_jax.train(line.replace(mistake_rate=0.1), teachers.host(function))
    assert [index for index, _ in heard] == list(range(line.num_rounds))
    np.testing.assert_array_equal(np.concatenate([numbers for _, numbers in heard]), np.arange(line.num_queries))
    assert np.all(result.preferences.weight == 1)
    np.testing.assert_array_equal(result.preferences.since[:3], [1, 1, 0])
    assert result.curves["surrogate_loss"].shape == (line.num_rounds,)


def test_a_host_that_says_at_once_what_the_synthetic_human_says_trains_the_same(line, taught):
    given = jax.tree.map(np.asarray, taught.preferences)
    answer = lambda queries, index: Answers(
        queries.number, given.preferred[queries.number], np.ones(queries.number.size)
    )
    result = peps_jax.train(line.replace(mistake_rate=0.1), teachers.host(answer))
    np.testing.assert_allclose(result.curves["critic_loss"], taught.curves["critic_loss"], rtol=1e-3, atol=1e-4)
    np.testing.assert_array_equal(result.preferences.number, taught.preferences.number)


def test_a_host_that_says_nothing_teaches_nothing(line):
    result = peps_jax.train(line, teachers.host(lambda queries, index: None))
    assert not np.any(result.preferences.weight)
    assert np.all(result.curves["surrogate_loss"] == 0)


def test_a_host_can_not_be_inside_a_program(line):
    with pytest.raises(ValueError, match=r"can't be inside jax\.jit"):
        jax.jit(lambda config: peps_jax.train(config, teachers.host(lambda queries, index: None)))(line)
