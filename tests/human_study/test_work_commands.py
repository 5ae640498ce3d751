"""The study's commands that compute: what they refuse, and one person who teaches an agent."""

import contextlib
import json
import os
import re
import signal
import sqlite3
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from commands import exit_code

from peps_jax.config import Config
from peps_jax.human_study import commands, making, pairs, simulated_participants
from peps_jax.human_study.database import Database
from peps_jax.human_study.settings import Folder
from peps_jax.human_study.simulated_participants import Door, Eyes, Minds, Participant
from peps_jax.settings import settings_of

ENV = "nav-d1"
# as in test_training.py, so that they share programs
SMALL = """
--total-steps 80 --num-envs 4 --rollout-length 10 --warmup-steps 0 --batch-size 8 --hidden-sizes 8 --model-hidden-sizes 8
--ensemble-size 2 --num-queries 4 --dynamics-updates 2 --dynamics-batch-size 8 --surrogate-updates 2
--surrogate-batch-size 8 --updates-per-step 0.1
""".split()


def run(capsys, *arguments):
    """A command's exit code, and what it printed on stdout and stderr."""
    code = exit_code(commands.main, *arguments)
    printed = capsys.readouterr()
    return code, printed.out, printed.err


@pytest.fixture
def empty(tmp_path):
    """A study that nobody has taken part in."""
    folder = Folder(tmp_path / "study")
    making.make(folder, ENV, ENV, dict(participants=1, pairs=4, repeats=0.0), with_pairs=False)
    return folder


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (["train"], "the study holds no answers to learn from"),
        (["train", "--method", "sarsa"], "method 'sarsa'"),
        (["train", "--lam", "-1"], "lam -1.0 is out of range"),
        (["train", "--seeds", "0"], "choose 1 to 1000"),
        (["train", "--live", "--method", "sac"], "'sac' asks nothing"),
        (["train", "--live", "--method", "peps", "drlhp"], "people in the loop has one method"),
        (["label", "--env", "nav-d2"], "env 'nav-d2' isn't that of the study"),
        (["simulate", "0"], "number 0 is out of range"),
        (["simulate", "3", "--phase", "third"], "phase 'third' is unknown"),
        (["train", "--rationality", "2"], "'--rationality' is unknown"),
    ],
)
def test_what_makes_no_sense_is_refused_in_one_line(empty, capsys, arguments, complaint):
    code, _, told = run(capsys, *arguments, "--out", empty.path)
    assert code == 2
    assert told.count("\n") == 1
    assert complaint in told


@pytest.mark.parametrize("command", ["train", "replay", "simulate 3", "analyse"])
def test_a_folder_without_a_study_is_refused(tmp_path, capsys, command):
    code, _, told = run(capsys, *command.split(), "--out", tmp_path)
    assert (code, told.count("\n")) == (2, 1)
    assert "holds no study" in told


def test_a_study_of_people_is_not_simulated_into(empty, capsys):
    with contextlib.closing(Database(empty.database)) as database:
        (number,) = database.invite("training", ["digest"])
        database.begin(number, "pairs", 0, lambda before: [])
    code, _, told = run(capsys, "simulate", 3, "--out", empty.path)
    assert code == 2
    assert "holds what people have said" in told


def test_nothing_was_trained_yet(empty, capsys):
    assert run(capsys, "replay", "--out", empty.path) == (0, "nothing was trained yet\n", "")


def test_an_analysis_of_nothing(empty, capsys):
    code, printed, _ = run(capsys, "analyse", "--out", empty.path)
    assert code == 0
    assert "0 participants began (nobody yet)" in printed


class Person(threading.Thread):
    """Somebody with the biased belief who opens the link that `label` prints, and answers `answers` pairs."""

    def __init__(self, out, link, answers, env=ENV):
        super().__init__(daemon=True)
        self._out, self._link, self._left, self._env = out, link, answers, env
        self.failed = None

    def run(self):
        """All that they do; what goes wrong is kept."""
        try:
            self._answer()
        except Exception as error:
            self.failed = error

    def _answer(self):
        address, token = re.fullmatch(r"(.*)/#(.*)", self._link).groups()
        problem = pairs.problem(self._env)
        with (
            contextlib.closing(Database(self._out / "study.sqlite")) as database,
            contextlib.closing(Door(address, token)) as door,
        ):
            eyes = Eyes(problem, lambda: simulated_participants.all_pairs(database))
            mind = Minds(problem.belief, settings_of(Config(env=self._env), problem).human, None)
            person = Participant(door, mind, 0, problem, eyes)
            while person.page != "done" and self._left:
                answers = person.page == "pairs"
                if person.go_on():
                    self._left -= answers
                else:
                    time.sleep(0.02)


@pytest.mark.slow
def test_one_person_teaches_an_agent_and_replays_it(tmp_path, capsys, monkeypatch):
    people = []

    def open_page(link):
        if "/researcher" not in link:
            people.append(Person(tmp_path, link, answers=4))
            people[-1].start()

    monkeypatch.setattr("webbrowser.open", open_page)
    code, printed, told = run(capsys, "label", "--env", ENV, "--port", 0, *SMALL, "--out", tmp_path)
    people[0].join(20)
    assert people[0].failed is None
    assert code == 0, told
    assert "watch it learn here: http://127.0.0.1:" in printed
    assert {"answers.npz", "picture.png", "routes.json"} <= {path.name for path in Path(tmp_path).iterdir()}
    assert run(capsys, "replay", "--out", tmp_path)[:2] == (
        0, "all 2 rounds ask and are told what they were, and the agent is the same\n",
    )  # fmt: skip
    code, _, told = run(capsys, "label", "--num-queries", 6, "--port", 0, "--out", tmp_path)
    assert code == 2
    assert "num_queries 6 doesn't agree" in told


@pytest.mark.long
def test_a_dry_run_of_a_whole_study(tmp_path, capsys):
    out = tmp_path / "study"
    numbers = "--participants 2 --pairs 10 --repeats 0.2 --shared 0.5".split()
    assert run(capsys, "make", "--env", ENV, *numbers, "--out", out)[0] == 0
    code, _, told = run(capsys, "simulate", 2, "--seeds", 1, "--total-steps", 800, "--out", out)
    assert code == 0, told
    assert told.count("agents learned") == 3
    assert "raters find a difference" in told
    code, printed, told = run(capsys, "replay", "--out", out)
    assert code == 0, told
    assert printed.count("answers and 1 agents are what they were") == 3
    code, printed, _ = run(capsys, "analyse", "--out", out)
    assert code == 0
    assert "repeated-measures ANOVA (main)" in printed
    with contextlib.closing(sqlite3.connect(out / "study.sqlite")) as connection, connection:
        connection.execute("DELETE FROM answer WHERE assignment = 1")
    code, _, told = run(capsys, "replay", "--out", out)
    assert code == 1
    assert re.fullmatch(r"participant 1's answer to query \d+ is missing since the agents were trained\n", told)


@contextlib.contextmanager
def labelling(out):
    """`label` as a user calls it, in a process of its own: the process, and the link that it prints."""
    command = [sys.executable, "-m", "peps_jax.human_study", "label", "--no-browser", "--port", "0", "--out", str(out)]
    environ = os.environ | {"XLA_FLAGS": "", "PYTHONUNBUFFERED": "1"}
    with subprocess.Popen(command, env=environ, stdout=subprocess.PIPE, text=True, encoding="utf-8") as process:
        try:
            yield process, process.stdout.readline().removeprefix("answer here:").strip()
        finally:
            process.kill()


@pytest.mark.long
def test_an_agent_takes_the_sand_after_a_hundred_answers_though_its_person_goes_and_comes_back(tmp_path):
    with labelling(tmp_path) as (process, link):
        for answers in (10, 11):  # the page is closed and opened again
            Person(tmp_path, link, answers, "nav-d4").run()
        process.send_signal(signal.SIGINT)
        process.communicate(timeout=60)
        assert process.returncode == 130
    with labelling(tmp_path) as (process, link):
        Person(tmp_path, link, 100, "nav-d4").run()
        process.communicate(timeout=120)
        assert process.returncode == 0
    with contextlib.closing(Database(tmp_path / "study.sqlite")) as database:
        assert len(database.tables()["answers"]) == 100
    route = np.array(json.loads((tmp_path / "routes.json").read_text(encoding="utf-8"))["route"])
    params = pairs.problem("nav-d4").params
    inside = lambda area: np.sum(np.all((route >= np.asarray(area)[:2]) & (route <= np.asarray(area)[2:]), 1))
    assert inside(params.sand) >= 3
    assert inside(params.ice) == 0
    assert inside(params.goal) == 1
