"""The analysis of a study: tables and figures from its database, and that they are the statistics of what was said."""

import contextlib
import csv
import json

import jax
import numpy as np
import pytest
from scipy import stats

from peps_jax.human_study import analysis, making, orders, pairs, statistics
from peps_jax.human_study.database import Database
from peps_jax.human_study.database.records import Watching
from peps_jax.human_study.settings import Folder
from peps_jax.storage.arrays import write_arrays

ENV = "nav-d1"
AGENTS = ("peps", "sac", "drlhp")
RATERS, TRAINERS = 6, 4
LEVEL = {"peps": 8, "sac": 5, "drlhp": 3}


def watching(reaction=900):
    return Watching(reaction_ms=reaction, watched_ms=2_000, hidden_ms=0, replays=0)


def rate_all(database, number, ratings):
    """A rater rates every scene; `ratings(agent, place)`."""
    agent_of = {scene: agent for agent, scenes in database.scenes().items() for scene in scenes}
    order = orders.of_scenes(number, number, database.scenes(), 3, {})
    database.begin(number, "ratings", number, lambda before: order)
    for place, one in enumerate(order):
        database.next_shown(number, lease=60)
        rating = ratings(agent_of[one.number], place)
        database.rate(number, place, rating, 9, watching(), f"rating {number} {place}")
    database.finish(number, "ratings", "code")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A study with trainers, one of whom always presses left, and raters, one of whom stopped early."""
    made = Folder(tmp_path_factory.mktemp("study"))
    making.make(made, ENV, ENV, dict(participants=TRAINERS, pairs=30, repeats=0.2, shared=0.5))
    draw = np.random.default_rng(0)
    with contextlib.closing(Database(made.database)) as database:
        trainers = database.invite("training", [f"trainer {place}" for place in range(TRAINERS)])
        for number in trainers:
            order = orders.of_pairs(number, 30, 0.2, 0.5)
            database.begin(number, "pairs", number, lambda before: order)  # noqa: B023
            for place, one in enumerate(order):
                database.next_shown(number, lease=60)
                first = "right" if one.swapped else "left"
                choice = "left" if number == trainers[-1] else "unclear" if place == 0 else first
                database.answer(number, place, choice, (9, 9), watching(), f"answer {number} {place}")
            database.finish(number, "pairs", "code")
        problem = pairs.problem(ENV)
        for place, agent in enumerate(AGENTS):
            shown = jax.tree.map(lambda rows: rows[:, 0], pairs.to_ask(ENV, place, 3))
            database.add_scenes(agent, pairs.scenes_of(problem, shown))
        raters = database.invite("testing", [f"rater {place}" for place in range(RATERS + 1)])
        for number in raters[:-1]:
            rate_all(database, number, lambda agent, place: int(np.clip(LEVEL[agent] + draw.integers(-1, 2), 1, 10)))
        database.begin(raters[-1], "ratings", 1, lambda before: orders.of_scenes(1, 1, database.scenes(), 3, {}))
        said = sorted({row["query"] for row in database.tables()["answers"] if row["preferred"] is not None})
    kept = {"queries": np.array(said), "logits": np.ones(len(said), np.float32)}
    write_arrays(made.path / "surrogate-peps.npz", made.database.name, kept)
    return made


@pytest.fixture(scope="module")
def tables(folder):
    with contextlib.closing(Database(folder.database)) as database:
        return database.tables()


def test_who_is_left_out(tables):
    assert analysis.excluded(tables, "training") == {TRAINERS: "100% on one side"}
    assert analysis.excluded(tables, "testing") == {TRAINERS + RATERS + 1: "not finished"}
    assert [row["why"] for row in analysis.left_out_rows(tables)] == ["100% on one side", "not finished"]


def test_ratings_are_each_raters_means(tables):
    found = analysis.rated(tables)
    assert found.agents == ("peps", "sac", "drlhp"), "in the order of the methods"
    assert found.means.shape == (RATERS, 3)
    for row, rater in zip(found.means, found.raters, strict=True):
        for mean, agent in zip(row, found.agents, strict=True):
            told = [one["rating"] for one in tables["ratings"] if (one["participant"], one["agent"]) == (rater, agent)]
            assert mean == pytest.approx(np.mean(told))
    assert found.scenes.shape == (RATERS, 9)


def test_tests_are_those_of_the_ratings(tables):
    found = analysis.rated(tables)
    main, ranks, plain = analysis.tests(found)
    assert main["statistic"] == pytest.approx(statistics.repeated_measures(found.means).anova.f)
    assert ranks["p"] == pytest.approx(stats.friedmanchisquare(*found.means.T).pvalue)
    assert plain["p"] == pytest.approx(stats.f_oneway(*found.means.T).pvalue)
    assert main["corrected p"] < 0.01
    first = analysis.agents_by_pairs(found)[0]
    assert (first["first"], first["second"]) == ("peps", "sac")
    assert first["low"] < first["difference"] < first["high"]
    assert analysis.agents(found, road=True)[0]["paper's"] == "7.6 ± 2.4"
    assert "paper's" not in analysis.agents(found, road=False)[0]


def test_agreement_is_of_those_who_count(tables):
    rows = {row["what"]: row for row in analysis.agreement(tables, analysis.rated(tables))}
    assert rows["repeats answered alike"]["value"] == 1
    assert rows["Krippendorff's α of ratings, interval"]["value"] > 0.5
    assert np.isnan(rows["Krippendorff's α of comparisons, nominal"]["value"]), "all who count prefer the first"
    assert 0.3 < rows["left chosen, where a side was"]["value"] < 0.7, "the one who always presses left doesn't count"


def test_predictions_are_of_each_who_counts(folder, tables):
    with contextlib.closing(Database(folder.database)) as database:
        rows = analysis.predictions(database, folder, tables)
    assert [row["participant"] for row in rows] == [1, 2, 3]
    assert all(row["r̂ predicts"] == 1 for row in rows), "the first is preferred, and so r-hat says"


def test_everything_is_written(folder):
    written = {path.name: path for path in analysis.write(folder)}
    assert {"analysis.md", "analysis.json", "figure3.png", "ratings.png", "power.png", "predictions.png"} <= set(
        written
    )
    words = written["analysis.md"].read_text(encoding="utf-8")
    for part in (
        "repeated-measures ANOVA (main)",
        "one-way ANOVA (the paper's)",
        "Krippendorff",
        "ICC(2,k)",
        "100% on one side",
    ):
        assert part in words
    assert "raters find a difference (p < 0.05)" in words
    numbers = json.loads(written["analysis.json"].read_text(encoding="utf-8"))
    assert [row["agent"] for row in numbers["agents"]] == ["peps", "sac", "drlhp"]
    with written["tests.csv"].open(encoding="utf-8", newline="") as file:
        assert len(list(csv.DictReader(file))) == 3


def test_a_study_without_ratings_has_a_text(tmp_path):
    made = Folder(tmp_path / "study")
    making.make(made, ENV, ENV, dict(participants=1, pairs=4, repeats=0.0), with_pairs=False)
    written = analysis.write(made)
    assert [path.name for path in written] == ["analysis.md", "analysis.json"]
    assert "nobody yet" in written[0].read_text(encoding="utf-8")
    assert analysis.planned(made).startswith("too few ratings")
