"""The driving study: who takes part, what they are asked, what is seen in a scene, and how it is rated and drawn."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from peps_envs.highway.vehicle import FASTER, IDLE, LANE_LEFT, SLOWER
from peps_jax import film, study

PLANS = {
    "steer": [LANE_LEFT, FASTER, *[IDLE] * 6],
    "brake, steer": [SLOWER, SLOWER, LANE_LEFT, *[IDLE] * 5],
    "brake": [SLOWER] * 8,
    "idle": [IDLE] * 8,
}


@jax.jit
def follow(plan, key):
    """Four scenes in the rain that follow `plan` (8,)."""
    return study.watch(lambda observation, key, time: jnp.repeat(plan[time], 4), study.road("highway-rain"), key, 4)


@pytest.fixture(scope="module")
def scenes():
    return {name: follow(jnp.array(plan), jax.random.key(0)) for name, plan in PLANS.items()}


@pytest.fixture(scope="module")
def given():
    return jax.jit(study.compare)(jax.random.key(3))


def test_participants_scatter_around_the_papers_means():
    people = study.recruit(jax.random.key(0), 4_000)
    ratings = np.stack(jax.tree.leaves(people.ratings))
    np.testing.assert_allclose(ratings.mean(1), [3.42, 4.57, 3.28, 3.78], atol=0.25)  # clipping at 5 takes a little
    assert ratings.min() >= 1
    assert ratings.max() <= 5
    assert np.mean(people.rationality == 0) == pytest.approx(study.CARELESS, abs=0.02)
    assert float(people.dry_share.min()) >= 0
    assert np.mean(people.dry_share) == pytest.approx(2 / 3, abs=0.02)
    again = study.recruit(jax.random.key(0), 4_000)
    np.testing.assert_array_equal(again.rationality, people.rationality)


def test_a_mind_lies_between_the_true_road_and_a_dry_one():
    _, rain, _ = study.road("highway-rain").task()
    _, dry, _ = study.road("highway-dry").task()
    person = jax.tree.map(lambda leaf: leaf[0], study.recruit(jax.random.key(0), 1))
    for share, expected in ((0.0, rain), (1.0, dry)):
        believed = study.mind(person.replace(dry_share=jnp.asarray(share)), rain).physics.friction
        np.testing.assert_allclose(believed.mean, expected.physics.friction.mean, rtol=1e-6)
        np.testing.assert_allclose(believed.sd, expected.physics.friction.sd, rtol=1e-6)


def test_the_sanity_check_removes_who_answers_at_random():
    people = study.recruit(jax.random.key(1), 200)
    passed = np.asarray(jax.jit(study.attentive)(jax.random.key(2), people))
    careless = np.asarray(people.rationality) == 0
    assert passed[~careless].all()
    assert 0.2 < passed[careless].mean() < 0.8, "a coin"


def test_nobody_is_shown_a_collision_but_in_the_sanity_check(given):
    assert given.answers.shape == (study.TRAINERS * study.ANSWERS,)
    assert not np.any(study.crashed(given.segments))
    assert set(np.unique(given.answers)) <= {0.0, 1.0}
    answered = np.asarray(given.answered).reshape(study.TRAINERS, -1)
    assert np.all(answered == answered[:, :1]), "all of a participant's answers count, or none"


def test_the_teacher_says_what_the_group_has_said(given):
    queries = jax.tree.map(lambda rows: rows[:7], given.segments)
    told = study.teacher(given).answer(jax.random.key(0), queries, study.road("highway-rain"))
    assert told.answers.shape == (7,)
    rows = np.asarray(given.segments.observation).reshape(len(given.answers), -1)
    for observation, answer in zip(np.asarray(told.segments.observation), told.answers, strict=True):
        (place,) = np.flatnonzero((rows == observation.reshape(1, -1)).all(1))[:1]
        assert given.answers[place] == answer


def test_behaviours_are_told_apart_by_what_is_seen(scenes):
    kinds = {name: np.asarray(study.behaviour(seen)).tolist() for name, seen in scenes.items()}
    assert kinds == {"steer": [0] * 4, "brake, steer": [1] * 4, "brake": [2] * 4, "idle": [2] * 4}
    assert np.all(study.crashed(scenes["idle"]))
    assert not np.any(study.crashed(scenes["steer"]))


def test_a_human_on_a_dry_road_likes_braking_best_and_swerving_late_more_than_at_once():
    human = study.road("highway-dry")
    person = jax.tree.map(lambda leaf: leaf[0], study.recruit(jax.random.key(0), 1))
    want = human.task()[2]
    person = person.replace(
        ratings=want.ratings, lane_change_cost=want.lane_change_cost, swerve_cost=want.swerve_cost,
        dry_share=jnp.ones(()),
    )  # fmt: skip
    dry = jax.jit(
        lambda plan: study.worth(
            person,
            study.watch(lambda observation, key, time: jnp.repeat(plan[time], 16), human, jax.random.key(0), 16),
            human,
        )
    )
    steer, later, brake, idle = (float(dry(jnp.array(plan)).mean()) for plan in PLANS.values())
    assert brake > later > steer > idle


def test_ratings_follow_the_participants_own_worth(scenes):
    config = study.road("highway-rain")
    shown = jax.tree.map(lambda *rows: jnp.concatenate([row[:1] for row in rows]), *scenes.values())
    people = study.recruit(jax.random.key(4), 200)
    ratings = np.asarray(jax.jit(lambda: study.rate(jax.random.key(5), people, shown, config))())
    assert ratings.shape == (200, 4)
    assert set(np.unique(ratings)) <= set(range(1, 11))
    crash = list(PLANS).index("idle")
    careful = np.asarray(people.rationality) > 0
    assert np.all(np.argmin(ratings[careful].mean(0)) == crash)
    assert ratings[~careful].mean() == pytest.approx(5.5, abs=0.5)


def test_analysis_of_variance_by_hand():
    group = study.analyse(
        {"peps": np.array([8.0, 9, 10]), "sac": np.array([5.0, 6, 7]), "drlhp": np.array([2.0, 3, 4])}
    )
    # between: 3 * (3^2 + 0 + 3^2) = 54 on 2 degrees of freedom; within: 6 on 6; F = 27
    assert group.eta_squared == pytest.approx(54 / 60)
    assert group.p == pytest.approx((1 + 27 * 2 / 6) ** -3, rel=1e-6)  # the F distribution's tail with 2 and 6
    assert group.mean == {"peps": 9, "sac": 6, "drlhp": 3}


def test_groups_of_raters(scenes):
    named = {"peps": scenes["brake, steer"], "sac": scenes["steer"], "drlhp": scenes["idle"]}
    found = study.groups(jax.random.key(0), named, study.road("highway-rain"), number=3)
    assert len(found) == 3
    assert all(min(group.mean, key=group.mean.get) == "drlhp" for group in found)
    findings = study.Findings(named, {}, {}, found).summary()
    assert json.loads(json.dumps(findings))["groups"] == 3
    renamed = study.groups(
        jax.random.key(0), dict(zip("abc", named.values(), strict=True)), study.road("highway-rain"), 3
    )
    assert [list(group.mean.values()) for group in renamed] == [list(group.mean.values()) for group in found]


def test_pictures(scenes, tmp_path):
    shown = {name: study.typical(seen) for name, seen in scenes.items()}
    film.strips(shown, "a note").savefig(tmp_path / "strips.png")
    film.animate({"steer": shown["steer"]}, tmp_path / "film.gif")
    from PIL import Image

    with Image.open(tmp_path / "film.gif") as gif:
        assert gif.n_frames > 8
    with Image.open(tmp_path / "strips.png") as picture:
        assert picture.width > picture.height


def test_a_moment_lies_between_two_steps(scenes):
    scene = study.typical(scenes["steer"])
    early, middle, late = (film.moment(scene, time) for time in (1.0, 1.5, 2.0))
    np.testing.assert_allclose(middle.x, (early.x + late.x) / 2)
    wreck = film.moment(study.typical(scenes["idle"]), 20.0)
    assert wreck.crashed.all()


@pytest.mark.slow
def test_a_small_study_from_end_to_end(tmp_path, monkeypatch):
    small = dict(num_envs=4, rollout_length=10, warmup_steps=40, batch_size=16, hidden_sizes=(8,), num_queries=20)
    monkeypatch.setattr(study, "SETTINGS", study.SETTINGS | small)
    summary = study.figure3(tmp_path, seeds=[0], steps=80, methods=("peps", "sac"))
    assert {path.name for path in tmp_path.iterdir()} == {"figure3.png", "figure3.gif", "study.json"}
    assert set(summary["ratings"]["mean"]) == {"peps", "sac"}
    assert summary["groups"] == study.GROUPS
