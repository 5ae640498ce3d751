"""Trainings by what people say: rounds that wait, come back and replay; a training from all that was said before."""

import json

import jax
import numpy as np
import pytest

from peps_envs.navigation import Navigation
from peps_jax import train
from peps_jax.human_study import pairs, training
from peps_jax.human_study.database import Database
from peps_jax.human_study.database.records import Place, Wait, Watching
from peps_jax.human_study.settings import Folder, template
from peps_jax.preferences import data, teachers
from peps_jax.preferences.data import Answers

ENV = "nav-d1"
SMALL = dict(
    total_steps=80, num_envs=4, rollout_length=10, warmup_steps=0, batch_size=8, hidden_sizes=(8,), model_hidden_sizes=(8,),
    ensemble_size=2, num_queries=4, dynamics_updates=2, dynamics_batch_size=8, surrogate_updates=2, surrogate_batch_size=8,
    updates_per_step=0.1,
)  # fmt: skip
WATCHED = Watching(reaction_ms=900, watched_ms=2_000, hidden_ms=0, replays=0)


def made(path, env=ENV):
    """A study's folder."""
    folder = Folder(path)
    path.mkdir(exist_ok=True)
    folder.file.write_text(template(env, env, driving=False, round_time=60.0), encoding="utf-8")
    Database.create(folder.database).close()
    return folder


class Person:
    """Somebody who answers whatever is shown, from the database itself."""

    def __init__(self, folder, places=20, choice=lambda place: "left"):
        self.database, self._choice = Database(folder.database), choice
        (self.number,) = self.database.invite("training", [f"digest {id(self)}"])
        order = [Place("ask", swapped=bool(place % 2)) for place in range(places)]
        self.database.begin(self.number, "pairs", 1, lambda before: order)

    def answer(self):
        """One pair; whether there was one."""
        shown = self.database.next_shown(self.number, lease=60)
        if shown is None or isinstance(shown, Wait):
            return False
        said = self._choice(shown.place)
        self.database.answer(self.number, shown.place, said, (9, 9), WATCHED, f"{self.number} {shown.place}")
        return True


def by(person):
    """What a training does while it waits."""
    return lambda database, round: person.answer()


class Away(Exception):
    """The person leaves."""


@pytest.fixture(scope="module")
def config():
    return training.live_config(ENV, **SMALL)


@pytest.fixture(scope="module")
def lived(config, tmp_path_factory):
    """A folder whose training is over, its person, and what was learned."""
    folder = made(tmp_path_factory.mktemp("lived"))
    person = Person(folder, choice=lambda place: ("left", "right", "equal", "unclear")[place % 4])
    person.database.begin_live()
    result = training.run(config, training.people(person.database, config.problem(), 60, by(person)))
    return folder, person, result


def same(one, other):
    assert training.digest(one) == training.digest(other)


def learned(result):
    return result.agents, result.knowledge, result.preferences


def test_answers_are_unswapped_and_who_cant_tell_says_nothing(lived):
    _, person, result = lived
    assert [round.why for round in person.database.rounds()] == ["all answered"] * 2
    # left, right, equal and can't tell at places 0 to 3, of which 1 and 3 are swapped
    told = dict(zip(np.asarray(result.preferences.number), np.asarray(result.preferences.weight), strict=True))
    assert sorted(told.values()) == [0, 1, 1, 1]
    said = sorted(np.asarray(result.preferences.preferred)[np.asarray(result.preferences.weight) > 0])
    assert said == [0.5, 1, 1], "left of a pair as it is, right of one that is swapped, and a tie"


def test_it_is_the_training_of_a_teacher_on_the_host(config, lived):
    given = jax.tree.map(np.asarray, lived[2].preferences)

    def from_file(queries, index):
        numbers = [number for number in queries.number if given.weight[number] > 0]
        return Answers(np.array(numbers, np.int32), given.preferred[numbers], np.ones(len(numbers)))

    same(learned(train(config, teachers.host(from_file))), learned(lived[2]))


def test_what_was_begun_goes_on_where_it_was(config, lived, tmp_path):
    folder = made(tmp_path)
    person = Person(folder, choice=lambda place: ("left", "right", "equal", "unclear")[place % 4])
    person.database.begin_live()

    def leaves(database, round):
        if round.number == 1:
            raise Away
        person.answer()

    with pytest.raises(Away):
        training.run(config, training.people(person.database, config.problem(), 60, leaves))
    assert len(person.database.rounds()) == 2
    result = training.run(config, training.people(person.database, config.problem(), 60, by(person)))
    same(learned(result), learned(lived[2]))


def test_a_round_closes_late_and_what_comes_then_is_not_mixed_in(config, tmp_path):
    folder = made(tmp_path)
    few, slow = Person(folder, choice=lambda place: "left"), Person(folder, choice=lambda place: "right")
    few.database.begin_live()
    shown = []

    def waiting(database, round):
        if not shown:
            shown.append(slow.database.next_shown(slow.number, lease=0))  # seen, and not answered yet
        assert database.settle_round(round.number, 60) is None or few.answer()
        if not few.answer() and database.round(round.number).closed is None:
            database.close_round(round.number)

    host = training.people(few.database, config.problem(), 60, waiting)
    result = training.run(config, host)
    assert np.sum(np.asarray(result.preferences.weight)) >= 2
    same(learned(training.run(config, training.people(few.database, config.problem(), 60, None))), learned(result))
    slow.database.answer(slow.number, shown[0].place, "right", (9, 9), WATCHED, "late")
    assert len(slow.database.late_answers()) == 1
    same(learned(training.run(config, training.people(few.database, config.problem(), 60, None))), learned(result))


def test_replaying_says_in_one_line_what_differs(config, lived, tmp_path):
    import shutil
    import sqlite3

    shutil.copytree(lived[0].path, tmp_path / "copy")
    path = tmp_path / "copy" / "study.sqlite"
    replayed = training.run(config, training.people(Database(path), config.problem(), 60, None))
    same(learned(replayed), learned(lived[2]))
    with sqlite3.connect(path) as connection:
        connection.execute("DELETE FROM answer WHERE assignment = (SELECT max(assignment) FROM answer)")
    with pytest.raises(
        training.DiffersError, match=r"^round 1 was closed with other answers \(all answered\): now query \d has"
    ):
        training.run(config, training.people(Database(path), config.problem(), 60, None))
    with pytest.raises(training.DiffersError, match="round 0 was asked with other queries"):
        training.run(config.replace(seed=5), training.people(Database(path), config.problem(), 60, None))


def test_replaying_ends_where_people_have(config, tmp_path):
    folder = made(tmp_path)
    with pytest.raises(training.ReplayedError):
        training.run(config, training.people(Database(folder.database), config.problem(), 60, None))


@pytest.mark.slow
def test_a_live_training_keeps_and_shows_what_it_learns(tmp_path, capsys):
    folder = made(tmp_path)
    person = Person(folder)
    live = training.Live(folder, SMALL)
    live._wait_plainly, live._wait = live._wait, lambda database, round: (
        live._wait_plainly(database, round), person.answer()
    )  # fmt: skip
    result = live.run()
    assert live.replay() == "all 2 rounds ask and are told what they were, and the agent is the same"
    live.close()
    assert folder.picture.read_bytes().startswith(b"\x89PNG")
    assert "after 2 of 2 rounds" in folder.routes.read_text(encoding="utf-8")
    same(data.load(folder.path / "answers.npz"), data.answered(result.preferences))
    assert "round 0: 2 pairs are asked; 1 rounds are to come" in capsys.readouterr().out
    assert Database(folder.database).live == "over"
    assert list(Database(folder.database).scenes()) == ["peps"]
    with pytest.raises(ValueError, match="num_queries 6 doesn't agree with what the training was begun with, 4"):
        training.Live(folder, {"num_queries": 6})


def test_settings_that_make_no_sense_are_refused_in_one_line():
    with pytest.raises(ValueError, match="'sac' asks nothing: choose one of peps, drlhp, policy_shaping"):
        training.live_config(ENV, method="sac")


# --- from the answers that are there ----------------------------------------------------------------------------------------


@pytest.mark.slow
def test_answers_through_the_database_teach_what_a_recorded_file_does(config, tmp_path):
    folder = made(tmp_path)
    problem = pairs.problem(ENV)
    asked = pairs.to_ask(ENV, 0, 6)
    database = Database(folder.database)
    database.add_queries("ask", pairs.pairs_of(problem, asked))
    with pytest.raises(ValueError, match="holds no answers to learn from"):
        training.preferences(database, problem)
    person, careless = Person(folder, 6), Person(folder, 3, lambda place: "right")
    while person.answer():
        pass
    while careless.answer():
        pass
    kept = training.preferences(database, problem, excluded=[careless.number])
    assert np.all(np.asarray(kept.weight) == 1)
    assert sorted(np.asarray(kept.preferred).tolist()) == [0, 0, 0, 1, 1, 1], "left, of which half are swapped"
    assert np.sum(np.asarray(training.preferences(database, problem).weight)) == 9
    data.save(tmp_path / "answers.npz", kept)
    again = data.load(tmp_path / "answers.npz")
    jax.tree.map(np.testing.assert_array_equal, kept, again)
    assert [leaf.dtype for leaf in jax.tree.leaves(kept)] == [leaf.dtype for leaf in jax.tree.leaves(again)]
    configs = [config.replace(seed=seed) for seed in range(2)]
    found, other = (training.learn(configs, one, scenes=2) for one in (kept, again))
    assert found.digest == other.digest
    assert found.scenes.mask.shape == (2, 2, Navigation.horizon)


@pytest.mark.parametrize(
    ("now", "what"),
    [
        ([[1, 1, 1.0]], "participant 2's answer to query 1 is missing"),
        ([[1, 1, 1.0], [1, 2, 0.5], [2, 1, None]], "participant 1's answer to query 2 is new"),
        ([[1, 1, 1.0], [1, 2, None]], "participant 2's answer to query 1 has changed"),
    ],
)
def test_one_line_says_which_answer_differs(now, what):
    before = [[1, 1, 1.0], [1, 2, 0.5]]
    training._check_told(before, before)
    with pytest.raises(training.DiffersError, match=f"^{what} since the agents were trained$"):
        training._check_told(before, now)


def test_a_lesson_is_read_back_from_what_is_noted():
    lesson = training.Lesson("peps", (0, 3), 2, {"hidden_sizes": (8, 8), "lam": 2.0})
    assert training.Lesson.read(json.loads(json.dumps(lesson.said()))) == lesson
    assert [config.seed for config in lesson.configs(ENV)] == [0, 3]
