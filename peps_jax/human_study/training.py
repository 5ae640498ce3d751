"""Trainings by what people say: from the answers that are there, or with people in the loop.

A round of a training that waits for people posts its queries to the database, and goes on when the database says that the round
is closed. The database is the truth: a training that is begun again is given the answers of its closed rounds, comes to the
same place, bit by bit on the same kind of machine, and asks on; so there is nothing else to keep, and `replay` is the same
training without anybody to ask.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from peps_jax import generator, methods
from peps_jax.config import Config, Problem
from peps_jax.drawing import scenes as drawing
from peps_jax.execution.devices import compile_over_devices
from peps_jax.execution.program import shared
from peps_jax.human_study import pairs, pictures
from peps_jax.human_study.database import Database
from peps_jax.human_study.database.records import Round, Said
from peps_jax.human_study.settings import Folder
from peps_jax.learning import surrogate
from peps_jax.preferences import data, teachers
from peps_jax.preferences.data import NOBODY, Answers, PreferenceSet, Queries, Segments
from peps_jax.reproduce.driving import experiment
from peps_jax.reproduce.driving.scenes import road
from peps_jax.round import round_at
from peps_jax.storage import files
from peps_jax.storage.arrays import write_arrays
from peps_jax.train import Result, check, finish, halves, init, prepare, run_with_host
from peps_jax.train import train as trained

LOOK = 0.05  # s between two looks whether a round is closed
ASKED = 100  # queries of a training that waits for people, unless it is told otherwise
NOTED, NOTED_RESULT = "live settings", "live result"  # under which the study keeps what is trained, and what came out

Host = Callable[[Queries, int], Answers | None]


class ReplayedError(Exception):
    """All rounds that people have closed are trained again."""


class DiffersError(Exception):
    """What a training asks, is told or learns isn't what it was before; one line says where it differs."""


# --- settings -------------------------------------------------------------------------------------------------------------


def config_of(env: str, **changes: Any) -> Config:
    """A training in an environment: the driving study's settings on a road, the library's elsewhere; and `changes`."""
    if pairs.is_road(env):
        return road(env, **(experiment.SETTINGS | changes))
    return Config(env=env, **changes)


def live_config(env: str, **changes: Any) -> Config:
    """A training that asks people between its rounds, `ASKED` queries in all by default.

    Raises:
      ValueError: a setting makes no sense, or the method asks nothing.
    """
    config = config_of(env, **({"num_queries": ASKED} | changes))
    check(config)
    if not methods.get(config.method).asks:
        names = ", ".join(name for name, method in methods.METHODS.items() if method.asks)
        raise ValueError(f"method {config.method!r} asks nothing: choose one of {names}")
    return config


# --- from the answers that are there --------------------------------------------------------------------------------------


def answers_of(said: Iterable[Said]) -> Answers:
    """What was said, under the numbers that the training gave its queries; who couldn't tell says nothing."""
    told = [one for one in said if one.preferred is not None]
    return Answers(
        number=np.array([one.asked for one in told], np.int32),
        preferred=np.array([one.preferred for one in told], np.float32),
        weight=np.ones(len(told), np.float32),
    )


def preferences(database: Database, problem: Problem, excluded: Iterable[int] = ()) -> PreferenceSet:
    """All that people said of pairs which were made beforehand, known from a training's first round on.

    Args:
      excluded: participants whose answers don't count.

    Raises:
      ValueError: there is no answer.
    """
    said = [one for one in database.answers(excluded=tuple(excluded)) if one.preferred is not None]
    if not said:
        raise ValueError("the study holds no answers to learn from: invite people to its training phase first")
    numbers = sorted({one.query for one in said})
    row = {number: place for place, number in enumerate(numbers)}
    segments = pairs.segments_of(problem, database.stimuli(numbers))
    return data.recording(segments, answers_of(one._replace(asked=row[one.query]) for one in said))


class Agents(NamedTuple):
    """Agents of one method, a row for each seed."""

    scenes: Segments  # (seeds, scenes, horizon, ...)
    learned: Any  # policies and what else was learned, (seeds, ...)
    logits: np.ndarray  # (seeds, answered pairs) of the first being preferred, by r-hat; 0 of a method that learns none

    @property
    def digest(self) -> str:
        """SHA-256 of all that was learned: equal for agents that are equal bit by bit."""
        return digest(self.learned)


def digest(tree: Any) -> str:
    """SHA-256 of a tree's arrays."""
    return files.json_digest([files.digest(np.asarray(leaf).tobytes()) for leaf in jax.tree.leaves(tree)])


def learn(configs: Sequence[Config], recorded: PreferenceSet, scenes: int) -> Agents:
    """Agents that differ in their seeds, taught what was recorded; each is watched in `scenes` scenes."""

    def one(config: Config) -> Agents:
        result = trained(config, teachers.recorded(recorded))
        key = jax.random.fold_in(generator.key(config.seed), 2)
        logits = jnp.zeros(recorded.number.shape[0], jnp.float32)
        if result.surrogate is not None:
            settings = result.training.settings.surrogate
            logits = jnp.mean(surrogate.preference_logits(result.surrogate, recorded, settings), 0)
        return Agents(pictures.watch(result, key, scenes), (result.agents, result.knowledge), logits)

    for config in configs:
        check(config)
        teachers.recorded(recorded).check(True, prepare(config).settings, config.num_rounds)
    program, runs = compile_over_devices(one, list(map(shared, configs)))
    return jax.tree.map(lambda rows: np.asarray(rows)[: len(configs)], program(runs))


@dataclasses.dataclass(frozen=True)
class Lesson:
    """Agents of one method that learn from a study's answers and act in its testing environment; noted in the study."""

    method: str
    seeds: tuple[int, ...]
    scenes: int  # in which each agent is watched
    changes: Mapping[str, Any]  # settings of the training

    def configs(self, test_env: str) -> list[Config]:
        """A training for each seed. Raises ValueError for settings that make no sense."""
        made = [
            config_of(test_env, **(dict(self.changes) | {"method": self.method, "seed": seed})) for seed in self.seeds
        ]
        for config in made:
            check(config)
        return made

    def said(self) -> dict[str, Any]:
        return json.loads(json.dumps(dataclasses.asdict(self)))

    @classmethod
    def read(cls, said: Mapping[str, Any]) -> Lesson:
        """What `said` told."""
        changes = {name: tuple(value) if isinstance(value, list) else value for name, value in said["changes"].items()}
        return cls(said["method"], tuple(said["seeds"]), said["scenes"], changes)


def teach(
    folder: Folder, lessons: Sequence[Lesson], excluded: Iterable[int], say: Callable[[str], None] = print
) -> None:
    """Trains agents from the answers that a study holds, and puts what they do there, for others to rate.

    Raises:
      ValueError: there are no answers, or such agents were trained from others; one line says which.
    """
    settings, database = folder.settings(), Database(folder.database)
    excluded = sorted(excluded)
    with contextlib.closing(database):
        problem, test = pairs.problem(settings.env), pairs.problem(settings.test_env)
        recorded = preferences(database, problem, excluded)
        told = _told(database, excluded)
        say(f"{len(told)} answers to {recorded.number.shape[0]} pairs, without those of {len(excluded)} participants")
        for lesson in lessons:
            configs, before = lesson.configs(settings.test_env), database.noted(f"agents {lesson.method}")
            agents = learn(configs, recorded, lesson.scenes)
            if before is not None and before["digest"] != agents.digest:
                raise ValueError(
                    f"method {lesson.method!r} has agents already, which learned something else: make a new study, for raters may "
                    "have seen them"
                )
            flat = jax.tree.map(lambda rows: rows.reshape(-1, *rows.shape[2:]), agents.scenes)
            new = database.add_scenes(lesson.method, pairs.scenes_of(test, flat))
            noted = {"lesson": lesson.said(), "excluded": excluded, "answers": told, "digest": agents.digest}
            database.note(f"agents {lesson.method}", noted)
            if np.any(agents.logits):
                kept = {"queries": _answered(database, excluded), "logits": agents.logits.mean(0)}
                write_arrays(folder.path / f"surrogate-{lesson.method}.npz", database.path.name, kept)
            say(f"{lesson.method}: {len(configs)} agents learned, {new} new scenes of them are there to be rated")


def _told(database: Database, excluded: Sequence[int]) -> list[list[Any]]:
    """Every answer that counts: query, participant, P(first preferred)."""
    return [[one.query, one.participant, one.preferred] for one in database.answers(excluded=excluded)]


def _answered(database: Database, excluded: Sequence[int]) -> np.ndarray:
    """Numbers of the queries that somebody has answered, in their order, as in `preferences`."""
    return np.array(sorted({query for query, _, preferred in _told(database, excluded) if preferred is not None}))


def replay_lessons(folder: Folder) -> list[str]:
    """Trains again what was trained from the study's answers; a line for each method.

    Raises:
      DiffersError: an answer is missing, new or another one, or something else is learned.
    """
    settings, lines = folder.settings(), []
    with contextlib.closing(Database(folder.database)) as database:
        for method in methods.METHODS:
            noted = database.noted(f"agents {method}")
            if noted is None:
                continue
            _check_told(noted["answers"], _told(database, noted["excluded"]))
            lesson = Lesson.read(noted["lesson"])
            recorded = preferences(database, pairs.problem(settings.env), noted["excluded"])
            if learn(lesson.configs(settings.test_env), recorded, lesson.scenes).digest != noted["digest"]:
                raise DiffersError(f"{method}: the answers are what they were, but what is learned differs")
            lines.append(f"{method}: {len(noted['answers'])} answers and {len(lesson.seeds)} agents are what they were")
    return lines


def _check_told(before: Sequence[Sequence[Any]], now: Sequence[Sequence[Any]]) -> None:
    """Raises DiffersError for the first answer that isn't what it was."""
    then, there = ({(row[0], row[1]): row[2] for row in rows} for rows in (before, now))
    for query, participant in sorted(then.keys() | there.keys()):
        key = query, participant
        if then.get(key, "none") != there.get(key, "none"):
            what = "is missing" if key not in there else "is new" if key not in then else "has changed"
            raise DiffersError(
                f"participant {participant}'s answer to query {query} {what} since the agents were trained"
            )


# --- with people in the loop ----------------------------------------------------------------------------------------------


def wait(database: Database, round: Round) -> None:
    """Waits a little for answers."""
    time.sleep(LOOK)


def people(
    database: Database, problem: Problem, round_time: float, waiting: Callable[[Database, Round], None] | None = wait
) -> Host:
    """Who answers as `teachers.host` wants it: people, through the database, in time.

    A round closes when all is answered, or 80 % after `round_time` seconds, or by the researcher's hand; what comes later is
    kept and not mixed in. A round that was closed before is answered at once.

    Args:
      waiting: is called again and again while a round is open; None where nobody is to be asked.
    """

    def answer(queries: Queries, index: int) -> Answers | None:
        there = np.flatnonzero(np.asarray(queries.number) != NOBODY)
        if not there.size:
            return None
        if waiting is None and not _is_closed(database, index):
            raise ReplayedError
        shown = pairs.pairs_of(problem, jax.tree.map(lambda rows: rows[there], queries.segments))
        try:
            now = database.open_round(index, [int(number) for number in queries.number[there]], shown)
        except ValueError as error:
            raise DiffersError(str(error)) from None
        if now.closed is not None:
            _check_answers(database, now)
        while database.settle_round(index, round_time) is None:
            waiting(database, now)
        return answers_of(database.answers(index))

    return answer


def _is_closed(database: Database, index: int) -> bool:
    return any(round.number == index and round.closed is not None for round in database.rounds())


def _check_answers(database: Database, round: Round) -> None:
    """Raises DiffersError if a closed round's answers aren't those that it was closed with."""
    if database.answers_digest(round.number) == round.answers_digest:
        return
    said = {one.query for one in database.answers(round.number)}
    silent = [row for row in database.tables()["queries"] if row["round"] == round.number and row["number"] not in said]
    if silent and round.why == "all answered":
        names = ", ".join(str(row["asked"]) for row in silent)
        what = f"query {names} has no answer" if len(silent) == 1 else f"queries {names} have no answer"
    else:
        what = f"{len(database.answers(round.number))} answers that aren't those of its digest"
    raise DiffersError(f"round {round.number} was closed with other answers ({round.why}): now {what}")


def run(config: Config, host: Host, after: Callable[[Result, int], None] | None = None) -> Result:
    """`train(config, teachers.host(host))`, with `after` called at the end of each round with what was learned so far."""
    check(config)
    teacher = teachers.host(host)
    training = prepare(config, teacher)
    return finish(*run_with_host(init(training, teacher), training, host, after), training)


def warm_up(config: Config) -> None:
    """Compiles what a round needs, so that nobody waits for it between two pairs."""
    training = prepare(config)
    state = init(training)
    now = round_at(jnp.zeros((), jnp.int32), state.key, training.settings.schedule)
    collect, file, learn = halves
    state, queries, _ = collect(state, now, training)
    silent = Answers(*(np.zeros(queries.number.shape, kind) for kind in (np.int32, np.float32, np.float32)))
    jax.block_until_ready(learn(file(state, data.checked(silent, len(silent.number)), now), now, training))


class Live:
    """A training of a study's folder that asks people between its rounds, and goes on where it was.

    Args:
      changes: settings of the training; those that it was begun with, if there are none.
      say: is told a line about each round.

    Raises:
      ValueError: a setting makes no sense, or isn't what the training was begun with.
    """

    def __init__(self, folder: Folder, changes: Mapping[str, Any], say: Callable[[str], None] = print):
        settings = folder.settings()
        self._folder, self._say, self._database = folder, say, Database(folder.database)
        try:
            agreed = _agreed(self._database.noted(NOTED), changes)
            self.config = live_config(settings.env, **agreed)
        except ValueError:
            self._database.close()
            raise
        self._database.note(NOTED, agreed)
        self._rates = settings.env == settings.test_env
        self._round_time = settings.round_time
        self._undrawn: tuple[Result, int] | None = None
        self._told: str | None = None

    def begin(self) -> None:
        """From now on whoever has no pair waits for one."""
        self._database.begin_live()

    def run(self) -> Result:
        """All rounds; returns when the last one is answered. What was learned is kept and shown then."""
        database, problem = self._database, self.config.problem()
        self.begin()
        warm_up(self.config)
        result = run(self.config, people(database, problem, self._round_time, self._wait), self._learned)
        self._draw()
        data.save(self._folder.path / "answers.npz", result.preferences)
        if self._rates:
            key = jax.random.fold_in(generator.key(self.config.seed), 2)
            scenes = pictures.watch(result, key, self._folder.settings().scenes)
            database.add_scenes(self.config.method, pairs.scenes_of(problem, scenes))
        database.note(NOTED_RESULT, digest((result.agents, result.knowledge)))
        database.end_live()
        return result

    def replay(self) -> str:
        """Trains again from what the database holds; says how far that is.

        Raises:
          DiffersError: a round asks something else than it did, or was told something else, or something else is learned.
        """
        try:
            result = run(self.config, people(self._database, self.config.problem(), self._round_time, waiting=None))
        except ReplayedError:
            closed = [round for round in self._database.rounds() if round.closed is not None]
            return f"{len(closed)} of {self.config.num_rounds} rounds are closed, and each asks and is told what it was"
        noted = self._database.noted(NOTED_RESULT)
        if noted not in (None, digest((result.agents, result.knowledge))):
            raise DiffersError("all rounds ask and are told what they were, but what is learned differs")
        return f"all {self.config.num_rounds} rounds ask and are told what they were, and the agent is the same"

    def close(self) -> None:
        self._database.close()

    def _wait(self, database: Database, round: Round) -> None:
        """Shows what was learned last, while people watch what is asked now; then waits."""
        overdue = time.time() - round.opened > self._round_time
        told = database.waits_for(round.number) if overdue else f"{round.asked} pairs are asked"
        if told != self._told:
            to_come = self.config.num_rounds - 1 - round.number
            self._say(f"round {round.number}: {told}; {to_come} rounds are to come")
            self._told = told
        self._draw()
        time.sleep(LOOK)

    def _learned(self, result: Result, index: int) -> None:
        self._undrawn, self._told = (result, index), None

    def _draw(self) -> None:
        if self._undrawn is None:
            return
        result, index = self._undrawn
        self._undrawn = None
        answered = int(np.sum(np.asarray(result.preferences.weight) > 0))
        show(self._folder, result, f"after {index + 1} of {self.config.num_rounds} rounds, {answered} pairs answered")


def show(folder: Folder, result: Result, note: str) -> None:
    """Writes what the researcher's page shows of a training: a picture, and the agent's latest route as numbers."""
    figure, scene = pictures.draw(result, note)
    files.write_with(folder.picture, lambda path: figure.savefig(path, dpi=110))
    see = jax.vmap(result.training.problem.environment.perceive)
    route = np.round(np.asarray(see(drawing.states_of(scene)), np.float64), 3).tolist()
    files.write_whole(folder.routes, json.dumps({"note": note, "route": route}).encode())


def _agreed(noted: Mapping[str, Any] | None, changes: Mapping[str, Any]) -> dict[str, Any]:
    """The settings that a training was begun with, or is. Raises ValueError if `changes` are others."""
    if noted is None:
        return dict(changes)
    noted = {name: tuple(value) if isinstance(value, list) else value for name, value in noted.items()}
    for name, value in changes.items():
        if noted.get(name) != value:
            raise ValueError(
                f"{name} {value} doesn't agree with what the training was begun with, {noted.get(name, 'the default')}: "
                "leave that flag out, or make a new study"
            )
    return noted
