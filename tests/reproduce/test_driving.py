"""The driving study: who takes part, what they are asked, what is seen in a scene, and how it is rated and drawn."""

import functools
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from peps_envs.highway.vehicle import FASTER, IDLE, LANE_LEFT, SLOWER
from peps_envs.scene import Rectangle
from peps_jax.drawing import scenes as pictures
from peps_jax.preferences import data, teachers
from peps_jax.reproduce import __main__ as command
from peps_jax.reproduce import store
from peps_jax.reproduce.driving import comparisons, experiment, participants, ratings, report
from peps_jax.reproduce.driving import scenes as road_scenes
from peps_jax.train import train

PLANS = {
    "steer": [LANE_LEFT, FASTER, *[IDLE] * 6],
    "brake, steer": [SLOWER, SLOWER, LANE_LEFT, *[IDLE] * 5],
    "brake": [SLOWER] * 8,
    "idle": [IDLE] * 8,
}


@jax.jit
def follow(plan, key):
    """Four scenes in the rain that follow `plan` (8,)."""
    return road_scenes.watch(
        lambda observation, key, time: jnp.repeat(plan[time], 4), road_scenes.road("highway-rain").problem(), key, 4
    )


@pytest.fixture(scope="module")
def scenes():
    return {name: follow(jnp.array(plan), jax.random.key(0)) for name, plan in PLANS.items()}


compare = jax.jit(comparisons.compare)


@pytest.fixture(scope="module")
def given():
    return compare(jax.random.key(3), comparisons.ANSWERS)


def test_participants_scatter_around_the_papers_means():
    people = participants.recruit(jax.random.key(0), 4_000)
    ratings = np.stack(jax.tree.leaves(people.ratings))
    np.testing.assert_allclose(ratings.mean(1), [3.42, 4.57, 3.28, 3.78], atol=0.25)  # clipping at 5 takes a little
    assert ratings.min() >= 1
    assert ratings.max() <= 5
    assert np.mean(people.rationality == 0) == pytest.approx(participants.CARELESS, abs=0.02)
    assert float(people.dry_share.min()) >= 0
    assert np.mean(people.dry_share) == pytest.approx(2 / 3, abs=0.02)
    again = participants.recruit(jax.random.key(0), 4_000)
    np.testing.assert_array_equal(again.rationality, people.rationality)


def test_a_mind_lies_between_the_true_road_and_a_dry_one():
    rain, dry = (road_scenes.road(f"highway-{name}").problem().params for name in ("rain", "dry"))
    person = jax.tree.map(lambda leaf: leaf[0], participants.recruit(jax.random.key(0), 1))
    for share, expected in ((0.0, rain), (1.0, dry)):
        believed = participants.mind(person.replace(dry_share=jnp.asarray(share)), rain).physics.friction
        np.testing.assert_allclose(believed.mean, expected.physics.friction.mean, rtol=1e-6)
        np.testing.assert_allclose(believed.sd, expected.physics.friction.sd, rtol=1e-6)


def test_the_sanity_check_removes_who_answers_at_random():
    people = participants.recruit(jax.random.key(1), 200)
    passed = np.asarray(jax.jit(participants.attentive)(jax.random.key(2), people))
    careless = np.asarray(people.rationality) == 0
    assert passed[~careless].all()
    assert passed[careless].mean() < 0.3, "a coin, and several times"


def test_nobody_is_shown_a_collision_but_in_the_sanity_check(given):
    pairs, answers = given
    assert answers.preferred.shape == (comparisons.TRAINERS * comparisons.ANSWERS,)
    assert not np.any(road_scenes.crashed(pairs))
    assert set(np.unique(answers.preferred)) <= {0.0, 1.0}
    silent = np.asarray(answers.weight).reshape(comparisons.TRAINERS, -1) == 0
    assert np.all(silent.all(1) | ~silent.any(1)), "all of a participant's answers count, or none"
    assert silent.mean() < 0.5


def test_both_pieces_of_a_pair_begin_alike(given):
    begun = jax.tree.map(lambda rows: np.asarray(rows[:, :, 0]), given[0].state)
    first, second = jax.tree.map(lambda rows: rows[:, 0], begun), jax.tree.map(lambda rows: rows[:, 1], begun)
    np.testing.assert_array_equal(first.time, second.time)
    fresh = first.time == 0
    assert fresh.mean() > comparisons.FROM_START
    for one, other in zip(jax.tree.leaves(first), jax.tree.leaves(second), strict=True):
        np.testing.assert_array_equal(one[fresh], other[fresh])
    lengths = np.asarray(given[0].mask).sum(-1)
    assert lengths.min() >= 1
    assert 0.3 < np.mean(lengths[:, 0] == lengths[:, 1]) < 0.8, "both kinds of pairs"


def test_drivers_who_act_on_purpose_wait_and_then_change_lane():
    planned = np.asarray(comparisons.plans(jax.random.key(0), 2_000))
    ways = {(action,) * wait + (LANE_LEFT,) * (wait < 8) for wait in range(9) for action in range(5)}
    purposeful = np.array([any(tuple(plan[: len(way)]) == way for way in ways) for plan in planned])
    assert comparisons.PURPOSEFUL <= purposeful.mean() < 1
    late = purposeful & (planned[:, 0] != LANE_LEFT)
    assert np.mean(planned[late, 0] == SLOWER) > comparisons.BRAKING
    assert np.mean(planned[late, 0] == IDLE) > 0.05
    assert set(np.unique(planned)) == set(range(5))


def test_behaviours_are_told_apart_by_what_is_seen(scenes):
    kinds = {name: np.asarray(road_scenes.behaviour(seen)).tolist() for name, seen in scenes.items()}
    assert kinds == {"steer": [0] * 4, "brake, steer": [1] * 4, "brake": [2] * 4, "idle": [3] * 4}
    assert np.all(road_scenes.crashed(scenes["idle"]))
    assert not np.any(road_scenes.crashed(scenes["steer"]))


def test_a_human_on_a_dry_road_likes_braking_best_and_swerving_late_more_than_at_once():
    human = road_scenes.road("highway-dry").problem()
    person = jax.tree.map(lambda leaf: leaf[0], participants.recruit(jax.random.key(0), 1))
    want = human.belief
    person = person.replace(
        ratings=want.ratings, lane_change_cost=want.lane_change_cost, swerve_cost=want.swerve_cost,
        dry_share=jnp.ones(()),
    )  # fmt: skip
    dry = jax.jit(
        lambda plan: ratings.worth(
            person,
            road_scenes.watch(lambda observation, key, time: jnp.repeat(plan[time], 16), human, jax.random.key(0), 16),
            human,
        )
    )
    steer, later, brake, idle = (float(dry(jnp.array(plan)).mean()) for plan in PLANS.values())
    assert brake > later > steer > idle


def test_ratings_follow_the_participants_own_worth(scenes):
    problem = road_scenes.road("highway-rain").problem()
    shown = jax.tree.map(lambda *rows: jnp.concatenate([row[:1] for row in rows]), *scenes.values())
    people = participants.recruit(jax.random.key(4), 200)
    given = np.asarray(jax.jit(lambda: ratings.rate(jax.random.key(5), people, shown, problem))())
    assert given.shape == (200, 4)
    assert set(np.unique(given)) <= set(range(1, 11))
    crash = list(PLANS).index("idle")
    careful = np.asarray(people.rationality) > 0
    assert np.all(np.argmin(given[careful].mean(0)) == crash)
    assert given[~careful].mean() == pytest.approx(5.5, abs=0.5)


def test_analysis_of_variance_by_hand():
    group = ratings.analyse(
        {"peps": np.array([8.0, 9, 10]), "sac": np.array([5.0, 6, 7]), "drlhp": np.array([2.0, 3, 4])}
    )
    # between: 3 * (3^2 + 0 + 3^2) = 54 on 2 degrees of freedom; within: 6 on 6; F = 27
    assert group.eta_squared == pytest.approx(54 / 60)
    assert group.p == pytest.approx((1 + 27 * 2 / 6) ** -3, rel=1e-6)  # the F distribution's tail with 2 and 6
    assert group.mean == {"peps": 9, "sac": 6, "drlhp": 3}


def test_groups_of_raters(scenes):
    named = {"peps": scenes["brake, steer"], "sac": scenes["steer"], "drlhp": scenes["idle"]}
    found = ratings.groups(jax.random.key(0), named, road_scenes.road("highway-rain").problem(), number=3)
    assert len(found) == 3
    assert all(min(group.mean, key=group.mean.get) == "drlhp" for group in found)
    findings = experiment.Findings(named, {}, {}, found, [])
    assert json.loads(json.dumps(report.summary(findings)))["groups"] == 3
    assert report.shares(found)["highest"] == np.mean(
        [max(group.mean, key=group.mean.get) == "peps" for group in found]
    )
    renamed = ratings.groups(
        jax.random.key(0), dict(zip("abc", named.values(), strict=True)), road_scenes.road("highway-rain").problem(), 3
    )
    assert [list(group.mean.values()) for group in renamed] == [list(group.mean.values()) for group in found]


def test_pictures(scenes, tmp_path):
    shown = {name: pictures.states_of(road_scenes.typical(seen)) for name, seen in scenes.items()}
    labels = [f"{time} s" for time in report.MOMENTS]
    pictures.strips(report.clips(shown, report.MOMENTS), labels, "a note").savefig(tmp_path / "strips.png")
    pictures.film(report.clips({"steer": shown["steer"]}, range(9)), tmp_path / "film.gif", rate=2)
    from PIL import Image

    with Image.open(tmp_path / "film.gif") as gif:
        assert (gif.n_frames, gif.info["duration"]) == (9, 500)
    with Image.open(tmp_path / "strips.png") as picture:
        assert picture.width > picture.height


def test_a_moment_lies_between_two_steps(scenes):
    cars = lambda scene: [shape for shape in scene.shapes if isinstance(shape, Rectangle)]
    shown = {name: pictures.states_of(road_scenes.typical(scenes[name])) for name in ("steer", "idle")}
    early, middle, late = (cars(scene) for scene in report.clips(shown, (1.0, 1.5, 2.0))["steer"])
    for before, now, after in zip(early, middle, late, strict=True):
        assert now.x == pytest.approx((before.x + after.x) / 2)
        assert now.angle == pytest.approx((before.angle + after.angle) / 2)
    (wreck,) = report.clips(shown, [20.0])["idle"]
    assert [car.colour for car in cars(wreck)] == ["wreck", "wreck"]


def test_conduct_counts_seeds_and_leaves_out_who_failed():
    seen = experiment.Seen(
        scenes=None,
        kind=np.array([[1, 1, 1, 0], [0, 0, 0, 0], [2, 2, 2, 2]]),
        crashed=np.array([[False] * 4, [False, False, False, True], [True] * 4]),
        return_=np.array([[6.0] * 4, [7.0] * 4, [np.nan] * 4]),
        finite=np.array([True, True, False]),
    )
    found = experiment.conduct(seen)
    assert (found.seeds_that(0), found.seeds_that(1), found.seeds_that(2), found.failed) == (1, 1, 0, 1)
    assert found.shares == [[0.25, 0.75, 0, 0], [1, 0, 0, 0]]
    assert found.crash_rate == [0, 0.25]
    assert found.return_ == [6, 7]


def test_the_studys_own_way_has_all_seeds_and_variants_few(monkeypatch):
    own, seeds = experiment.OWN, range(3, 13)
    monkeypatch.setattr(experiment, "METHODS", ("peps", "sac"))
    monkeypatch.setattr(experiment, "LAMS", (0.0, own.lam, 8.0))
    monkeypatch.setattr(experiment, "EACH", (2, own.each))
    peps, sac, over_lambda, over_answers = experiment.parts(seeds, 80)
    assert peps.variants == sac.variants == (own,)
    assert [variant.lam for variant in over_lambda.variants] == [0.0, 8.0]
    assert [variant.each for variant in over_answers.variants] == [2]
    assert (peps.seeds, over_lambda.seeds) == (tuple(seeds), tuple(seeds[: experiment.FEW_SEEDS]))
    asked = [(float(config.lam), config.seed, each) for config, each in over_lambda.agents]
    assert asked == [(lam, seed, own.each) for lam in (0.0, 8.0) for seed in over_lambda.seeds]
    assert len({part.name for part in (peps, sac, over_lambda, over_answers)}) == 4
    monkeypatch.setattr(experiment, "LAMS", (own.lam,))
    monkeypatch.setattr(experiment, "EACH", (own.each,))
    assert len(experiment.parts(seeds, 80)) == 2


def test_variants_are_told_by_what_they_differ_in():
    own = experiment.OWN
    tried = {experiment.Variant(lam=8.0): "long", own: "own", experiment.Variant(each=20): "few"}
    findings = experiment.Findings(scenes={}, conduct={}, variants=tried, groups=[], wider=[])
    assert findings.over("lam") == {own.lam: "own", 8.0: "long"}
    assert findings.over("each") == {20: "few", own.each: "own"}


def test_fewer_answers_are_the_first_of_everybody(given):
    (pairs, all_given), (same, few) = given, compare(jax.random.key(3), 3)
    place = np.arange(len(all_given.weight)) % comparisons.ANSWERS
    np.testing.assert_array_equal(few.weight, np.where(place < 3, all_given.weight, 0))
    assert 0 < np.sum(few.weight > 0) <= 3 * comparisons.TRAINERS
    np.testing.assert_array_equal(few.preferred[few.weight > 0], all_given.preferred[few.weight > 0])
    np.testing.assert_array_equal(pairs.mask, same.mask)


@pytest.mark.slow
def test_a_small_study_from_end_to_end(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(comparisons, "ANSWERS", 2)
    small = dict(num_envs=4, rollout_length=10, warmup_steps=40, batch_size=16, hidden_sizes=(8,))
    monkeypatch.setattr(experiment, "SETTINGS", experiment.SETTINGS | small)
    monkeypatch.setattr(experiment, "EPISODES", 8)
    monkeypatch.setattr(experiment, "METHODS", ("peps", "sac"))
    monkeypatch.setattr(experiment, "LAMS", ())
    monkeypatch.setattr(experiment, "EACH", ())
    monkeypatch.setattr(experiment, "findings", functools.partial(experiment.findings, number=3))
    arguments = ["figure3", "--seeds", "2", "--steps", "80", "--out", str(tmp_path)]
    assert command.main(arguments) == 0
    files = {report.TABLE, report.PICTURE, report.FILM, report.NUMBERS}
    assert {path.name for path in tmp_path.iterdir()} == files | {store.HEAD, store.KEPT}
    numbers = json.loads((tmp_path / report.NUMBERS).read_text(encoding="utf-8"))
    assert set(numbers["ratings"]["mean"]) == {"peps", "sac"}
    assert [line["lam"] for line in numbers["over_lam"]] == [experiment.OWN.lam]
    assert [line["each"] for line in numbers["over_each"]] == [experiment.OWN.each]
    assert (tmp_path / report.TABLE).read_text(encoding="utf-8") in capsys.readouterr().out


@pytest.mark.slow
def test_an_agent_is_taught_all_answers(given):
    """By the recorded teacher: nothing else is asked, and all that was said counts from the first round on."""
    pairs, answers = jax.tree.map(lambda rows: rows[:21], given)
    small = dict(num_envs=4, rollout_length=10, warmup_steps=40, batch_size=16, hidden_sizes=(8,))
    config = experiment.settings("drlhp", 0, 80, **small)
    teach = lambda config, pairs, answers: train(config, teachers.recorded(data.recording(pairs, answers)))
    learned = jax.jit(teach)(config, pairs, answers).preferences
    np.testing.assert_array_equal(learned.preferred, jnp.where(answers.weight > 0, answers.preferred, 0.0))
    np.testing.assert_array_equal(learned.weight, answers.weight)
    np.testing.assert_array_equal(learned.mask, pairs.mask)
    assert not np.any(learned.since)
