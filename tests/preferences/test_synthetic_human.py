"""The synthetic human answers by Eq. (2)."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import LineParams, Point, settings

from peps_jax.preferences import synthetic_human, teachers
from peps_jax.preferences.data import Queries, Segments

REPEATS = 4000


def query(first, second, mask=None):
    """A query about where the point was seen, step by step; it stood at 0 before each, and no action was taken."""
    places = jnp.asarray([[first, second]], jnp.float32)[..., None]
    before, time = jnp.zeros_like(places), jnp.zeros(places.shape[:-1], jnp.int32)
    mask = jnp.ones(places.shape[:-1], bool) if mask is None else jnp.asarray([mask], bool)
    nothing = jnp.zeros_like(places)
    return Segments(before, nothing, mask, nothing[..., 0], Point(before, time), Point(places, time))


def weight(place, params):
    """l_H + r_H of a step from 0 to `place`, in plain numbers."""
    variance = params.noise**2 + params.width**2
    log_belief = -0.5 * (place**2 / variance + np.log(variance / params.width**2))
    return log_belief + params.slope * place


def share_of_first(config, segments, key=0):
    """How often the first segment is preferred, of many answers to one query."""
    many = jax.tree.map(lambda rows: jnp.repeat(rows, REPEATS, 0), segments)
    queries = Queries(jnp.arange(REPEATS), many)
    return jax.jit(synthetic_human.answer)(jax.random.key(key), queries, config.problem(), settings(config).human)


def values_of(segments, config):
    """By the belief."""
    return synthetic_human.segment_values(segments, config.problem(), settings(config).human)[..., 0]


def test_log_weight_is_belief_and_reward(line):
    parts = synthetic_human.log_weight(
        line.env, line.belief, Point(jnp.zeros(1), 0), jnp.zeros(1), Point(jnp.full(1, 0.2), 1)
    )
    np.testing.assert_allclose(sum(parts), weight(0.2, line.belief), rtol=1e-5)


def test_segment_values_sum_up_to_the_mask(line):
    values = values_of(query([0.1, 0.2, 9.0], [0.3, 0.0, 0.1], [[1, 1, 0], [1, 1, 1]]), line)
    expected = [sum(weight(place, line.belief) for place in places) for places in ([0.1, 0.2], [0.3, 0.0, 0.1])]
    np.testing.assert_allclose(values[0], expected, rtol=1e-5)


def test_what_was_judged_when_it_was_made_is_not_judged_again(line):
    segments = query([0.1, 0.2, 9.0], [0.3, 0.0, 0.1], [[1, 1, 0], [1, 1, 1]])
    said = synthetic_human.judge(segments, line.problem())
    np.testing.assert_allclose(values_of(segments._replace(worth=said), line), values_of(segments, line), rtol=1e-6)
    doubled = values_of(segments._replace(worth=2 * said, state=None), line)
    np.testing.assert_allclose(doubled, 2 * values_of(segments, line), rtol=1e-6)


def test_myopia_weighs_the_end(line):
    segments = query([0.1, 0.2, 9.0], [0.3, 0.0, 0.1], [[1, 1, 0], [1, 1, 1]])
    values = values_of(segments, line.replace(myopia=0.5))
    first = 0.5 * weight(0.1, line.belief) + weight(0.2, line.belief)
    second = 0.25 * weight(0.3, line.belief) + 0.5 * weight(0.0, line.belief) + weight(0.1, line.belief)
    np.testing.assert_allclose(values[0], [first, second], rtol=1e-5)


@pytest.mark.parametrize(("rationality", "mistake_rate"), [(1.0, 0.0), (3.0, 0.0), (3.0, 0.2)])
def test_answers_follow_eq_2(line, rationality, mistake_rate):
    config = line.replace(rationality=rationality, mistake_rate=mistake_rate)
    segments = query([0.0, 0.1], [0.2, 0.1])
    difference = float(np.subtract(*values_of(segments, config)[0]))
    right = 1 / (1 + np.exp(-rationality * difference))
    probability = right * (1 - mistake_rate) + (1 - right) * mistake_rate
    answers = share_of_first(config, segments)
    assert set(np.unique(answers.preferred)) <= {0.0, 1.0}
    error = 4 * np.sqrt(probability * (1 - probability) / REPEATS)
    assert abs(float(jnp.mean(answers.preferred)) - probability) < error
    assert bool(jnp.all(answers.weight == 1))


@pytest.mark.parametrize("informed", [0.0, 0.3, 1.0])
def test_a_share_of_the_answers_is_by_somebody_who_knows_the_truth(line, informed):
    config = line.replace(informed=informed, belief=LineParams(noise=0.1, slope=10.0))
    segments = query([0.0, 0.1], [0.2, 0.1])
    of = lambda belief: 1 / (1 + np.exp(-float(np.subtract(*values_of(segments, config.replace(belief=belief))[0]))))
    probability = informed * of(line.params) + (1 - informed) * of(config.belief)
    assert abs(of(line.params) - of(config.belief)) > 0.1
    error = 4 * np.sqrt(probability * (1 - probability) / REPEATS)
    assert abs(float(jnp.mean(share_of_first(config, segments).preferred)) - probability) < error


def test_indifference_is_a_tie(line):
    segments = query([0.0, 0.1], [0.2, 0.1])
    difference = abs(float(np.subtract(*values_of(segments, line)[0])))
    assert bool(jnp.all(share_of_first(line.replace(indifference=1.01 * difference), segments).preferred == 0.5))
    assert not bool(jnp.any(share_of_first(line.replace(indifference=0.99 * difference), segments).preferred == 0.5))


def test_skips_where_both_are_bad(line):
    segments = query([0.0, 0.1], [0.2, 0.1])
    best = float(jnp.max(values_of(segments, line)))
    assert bool(jnp.all(share_of_first(line.replace(skip_below=best + 0.1), segments).weight == 0))
    assert bool(jnp.all(share_of_first(line.replace(skip_below=best - 0.1), segments).weight == 1))


def test_teacher_is_a_value():
    assert teachers.SYNTHETIC.answer is synthetic_human.answer
