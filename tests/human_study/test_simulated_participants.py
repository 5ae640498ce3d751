"""Synthetic participants over HTTP: a whole study, and a training that equals that from a recorded file of the same answers."""

import contextlib
import threading

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from peps_jax import generator
from peps_jax.human_study import making, pairs, simulated_participants, training
from peps_jax.human_study.database import Database
from peps_jax.human_study.server import Study
from peps_jax.human_study.serving import Serving
from peps_jax.human_study.settings import Folder
from peps_jax.human_study.simulated_participants import Door, Eyes, RefusedError, minds, prefers, ratings
from peps_jax.preferences import data
from peps_jax.preferences.data import Answers

ENV = "nav-d1"
NUMBERS = dict(participants=3, pairs=10, repeats=0.2, shared=0.3)


@pytest.fixture(scope="module")
def held(tmp_path_factory):
    """A study that three synthetic people have taken part in, over HTTP."""
    folder = Folder(tmp_path_factory.mktemp("study"))
    making.make(folder, ENV, ENV, NUMBERS)
    with contextlib.closing(Serving(Study(folder))) as serving, serving.in_background():
        database = Database(folder.database)
        people = simulated_participants.take_seats(database, serving.address, ENV, "training", 3, seed=0)
        simulated_participants.take_part(people)
    return folder, database, people


def test_they_go_through_all_pages_and_answer_everything(held):
    _, database, people = held
    assert [person.page for person in people] == ["done"] * 3
    assert len({person.code for person in people}) == 3
    assert len(database.tables()["answers"]) == 3 * NUMBERS["pairs"]
    assert not database.check_integrity()
    for one in database.tables()["participants"]:
        assert (one["outcome"], one["consented"]) == ("finished", 1)


def test_what_they_say_of_what_they_see_is_filed_under_what_it_was(held):
    """Sides are swapped in between: the database's answers are those of the synthetic human to the segments themselves."""
    _, database, _ = held
    problem, people = pairs.problem(ENV), minds(ENV, 0, 3)
    for row in database.tables()["answers"][:6]:
        pair = jax.tree.map(lambda rows: rows[0], pairs.segments_of(problem, database.stimuli([row["query"]])))
        sides = [jax.tree.map(lambda rows: rows[side], pair) for side in (0, 1)]  # noqa: B023, used at once
        left, right = sides[::-1] if row["swapped"] else sides
        mind = jax.tree.map(lambda rows: rows[row["participant"] - 1], people)  # noqa: B023
        key = jax.random.fold_in(generator.key(row["participant"] - 1), row["place"])
        said = prefers(key, left, right, problem.replace(belief=mind.belief), mind.manner)
        assert row["preferred"] == (1 - said if row["swapped"] else said)


def test_a_training_from_answers_over_http_is_that_from_the_recorded_file(held, tmp_path):
    _, database, _ = held
    kept = training.preferences(database, pairs.problem(ENV))
    assert np.sum(np.asarray(kept.weight)) == sum(
        row["kind"] != "repeat" and row["preferred"] is not None for row in database.tables()["answers"]
    )
    data.save(tmp_path / "answers.npz", kept)
    again = data.load(tmp_path / "answers.npz")
    for one, other in zip(jax.tree.leaves(data.answered(kept)), jax.tree.leaves(again), strict=True):
        np.testing.assert_array_equal(one, other)


def test_wrong_tokens_and_unknown_clips_are_errors(held):
    folder, database, _ = held
    with (
        contextlib.closing(Serving(Study(folder))) as serving,
        serving.in_background(),
        contextlib.closing(Door(serving.address, "wrong")) as door,
        pytest.raises(RefusedError, match="401"),
    ):
        door.get("state")
    eyes = Eyes(pairs.problem(ENV), lambda: simulated_participants.all_pairs(database))
    with pytest.raises(ValueError, match="doesn't hold"):
        eyes.see({"shapes": []})


def test_people_differ_and_some_are_careless():
    many = minds(ENV, 0, 500)
    rationality = np.asarray(many.manner.rationality)
    assert 0.05 < np.mean(rationality == 0) < 0.15
    assert np.std(np.log(rationality[rationality > 0])) == pytest.approx(simulated_participants.SPREAD, rel=0.15)
    drivers = minds("highway-dry", 0, 50)
    assert set(np.unique(drivers.importance)) <= {1, 2, 3, 4, 5}
    assert np.std(np.asarray(drivers.belief.ratings.speed)) > 0.3, "each has a mind of their own"


def test_raters_like_what_they_expect():
    problem = pairs.problem(ENV)
    scenes = jax.tree.map(lambda rows: rows[:, 0], pairs.to_ask(ENV, 0, 8))
    given = np.asarray(ratings(jax.random.key(0), scenes, problem, jnp.float32(1)))
    assert given.min() >= 1
    assert given.max() <= 10
    worth = np.asarray(simulated_participants.worth(scenes, problem))
    assert np.corrcoef(np.argsort(np.argsort(worth)), given)[0, 1] > 0.7


@pytest.mark.slow
def test_a_live_training_over_http_is_that_of_a_file_and_replays(tmp_path):
    small = dict(
        total_steps=80, num_envs=4, rollout_length=10, warmup_steps=0, batch_size=8, hidden_sizes=(8,), ensemble_size=2,
        model_hidden_sizes=(8,), num_queries=4, dynamics_updates=2, surrogate_updates=2, updates_per_step=0.1,
    )  # fmt: skip
    folder = Folder(tmp_path / "study")
    making.make(folder, ENV, ENV, dict(pairs=10), with_pairs=False)
    live = training.Live(folder, small, say=lambda line: None)
    with contextlib.closing(Serving(Study(folder))) as serving, serving.in_background():
        database = Database(folder.database)
        database.begin_live()
        (person,) = simulated_participants.take_seats(database, serving.address, ENV, "training", 1, seed=3)
        over = threading.Event()

        def answer():
            while not over.wait(0.01) and person.page != "done":
                person.go_on()

        thread = threading.Thread(target=answer)
        thread.start()
        try:
            result = live.run()
        finally:
            over.set()
            thread.join()
            person.leave()
    given = jax.tree.map(np.asarray, data.load(folder.path / "answers.npz"))

    def from_file(queries, index):
        of = {number: row for row, number in enumerate(given.number)}
        rows = [of[number] for number in queries.number if number in of]
        return Answers(given.number[rows], given.preferred[rows], given.weight[rows])

    again = training.run(live.config, from_file)
    assert training.digest((again.agents, again.knowledge)) == training.digest((result.agents, result.knowledge))
    assert live.replay().startswith("all 2 rounds ask and are told what they were")
    live.close()
