"""Commands that compute: training from answers or with people in the loop, its replay, simulated participants, the analysis."""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import sys
import time
import webbrowser
from collections.abc import Callable
from pathlib import Path
from typing import Any

from peps_jax.command_line import Work, called, options, refuse, shown
from peps_jax.config import Config
from peps_jax.human_study import analysis, making, simulated_participants, tokens, training
from peps_jax.human_study.action import Action, Errand
from peps_jax.human_study.database import Database
from peps_jax.human_study.server import Study
from peps_jax.human_study.serving import Serving
from peps_jax.human_study.settings import PORT, Folder
from peps_jax.human_study.training import DiffersError, Lesson, Live
from peps_jax.reproduce.driving import experiment

PROG = called("peps_jax.human_study", "peps-study")
OWN = ("env", "params", "belief", "method")  # what a study says itself, and what has a flag of its own
SEEDS = 5  # agents of a method
LABELLED = "nav-d4"
PARTING = 8.0  # s that a page has to fetch its last words
KEPT = "every answer is kept; the same command goes on"


def _training_flags(parser: argparse.ArgumentParser) -> None:
    """A flag for each setting of a training."""
    group = parser.add_argument_group("settings of the training, by default the driving study's on a road")
    for field in dataclasses.fields(Config):
        if field.name in OWN or field.metadata.get("group") == "human" or not field.metadata.get("flag", True):
            continue
        flag, text = f"--{field.name.replace('_', '-')}", field.metadata["help"].replace("%", "%%")
        shown_default = f" [{shown(field.default)}]"
        group.add_argument(
            flag,
            default=argparse.SUPPRESS,
            help=text + shown_default,
            dest=f"set_{field.name}",
            **options(field.default),
        )


def _changes(values: argparse.Namespace) -> dict[str, Any]:
    """The settings that were given."""
    given = {name.removeprefix("set_"): value for name, value in vars(values).items() if name.startswith("set_")}
    return {name: tuple(value) if isinstance(value, list) else value for name, value in given.items()}


def _folder(values: argparse.Namespace) -> Folder:
    folder = Folder(Path(values.out))
    folder.check()
    return folder


def _in_one_line(name: str, do: Callable[[], None]) -> Callable[[], int]:
    """`do` as a command: what it raises of bad input, or of a study that isn't what it was, is one line."""

    def act() -> int:
        try:
            do()
        except DiffersError as error:
            print(error, file=sys.stderr)
            return 1
        except ValueError as error:
            return refuse(f"{PROG} {name}", error)
        return 0

    return act


# --- label ----------------------------------------------------------------------------------------------------------------


def _label_flags(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--env", default=None, metavar="NAME", help=f"in which the agent learns [{LABELLED}]")
    parser.add_argument("--method", default=None, metavar="NAME", help="peps, drlhp or policy_shaping [peps]")
    parser.add_argument("--port", default=PORT, help=f"where the page is [{PORT}]", **options(PORT))
    parser.add_argument("--no-browser", action="store_true", help="only print the links")
    _training_flags(parser)


def _label(values: argparse.Namespace) -> Work:
    folder, changes = Folder(Path(values.out)), _changes(values)
    if values.method is not None:
        changes["method"] = values.method
    if not folder.database.is_file():
        env = values.env or LABELLED
        config = training.live_config(env, **changes)
        pairs = config.num_queries + config.num_queries % 2
        making.make(
            folder, env, env, dict(participants=1, pairs=pairs, repeats=0.0, checks=0, shared=0.0), with_pairs=False
        )
    env = _folder(values).settings().env
    if values.env not in (None, env):
        raise ValueError(f"env {values.env!r} isn't that of the study in {values.out!r}, {env!r}: choose another --out")
    live, study = Live(folder, changes), Study(folder)
    try:
        serving = Serving(study, port=values.port)
    except ValueError:
        live.close()
        study.database.close()
        raise
    token = tokens.derived(serving.study.key, "label")
    if serving.study.database.holder(tokens.digest(token)) is None:
        (number,) = serving.study.database.invite("label", [tokens.digest(token)])
        serving.study.begin(number, "label", "instructions")
    link = f"{serving.address}/#{token}"

    def label() -> None:
        live.begin()
        with serving.in_background():
            print(f"answer here:         {link}\nwatch it learn here: {serving.researcher_link}", flush=True)
            if not values.no_browser:
                webbrowser.open(serving.researcher_link)
                webbrowser.open(link)
            live.run()
            print(f"it has learned from your answers: {folder.picture}", flush=True)
            _let_them_see(serving.study.database)

    def close() -> None:
        live.close()
        serving.close()

    return Errand(_in_one_line("label", label), kept=KEPT, close=close)


def _let_them_see(database: Database) -> None:
    """Waits until the page has said that there is nothing more; not long, for it may be closed."""
    until = time.monotonic() + PARTING
    while time.monotonic() < until:
        time.sleep(0.2)
        if all(one.page == "done" for one in database.participants() if one.phase == "label"):
            time.sleep(1.0)
            return


# --- train, replay --------------------------------------------------------------------------------------------------------


def _train_flags(parser: argparse.ArgumentParser) -> None:
    text = f"{', '.join(experiment.METHODS)}, ... [{shown(experiment.RATED)}; --live: peps]"
    parser.add_argument("--method", nargs="+", default=None, metavar="NAME", help=text)
    parser.add_argument(
        "--live", action="store_true", help="rounds that wait for people, in place of what was said before"
    )
    parser.add_argument("--seeds", default=SEEDS, help=f"agents of each method [{SEEDS}]", **options(SEEDS))
    parser.add_argument("--scenes", default=3, help="scenes of each agent that may be rated [3]", **options(3))
    _training_flags(parser)


def _train(values: argparse.Namespace) -> Work:
    folder, changes = _folder(values), _changes(values)
    if values.live:
        return _train_live(folder, values.method, changes)
    if not 1 <= values.seeds <= 1_000 or not 1 <= values.scenes <= 1_000:
        raise ValueError(f"seeds {values.seeds} or scenes {values.scenes} are out of range: choose 1 to 1000")
    first = changes.pop("seed", 0)
    seeds = tuple(range(first, first + values.seeds))
    lessons = [Lesson(method, seeds, values.scenes, changes) for method in values.method or experiment.RATED]
    for lesson in lessons:
        lesson.configs(folder.settings().test_env)

    def train() -> None:
        training.teach(folder, lessons, analysis.left_out(folder, "training"), _say)

    return Errand(_in_one_line("train", train), kept="agents that are trained are kept")


def _train_live(folder: Folder, method: list[str] | None, changes: dict[str, Any]) -> Work:
    if method is not None and len(method) != 1:
        raise ValueError(f"method {' '.join(method)}: a training with people in the loop has one method")
    live = Live(folder, changes | ({} if method is None else {"method": method[0]}), _say)

    def train() -> None:
        live.run()
        print(f"all rounds are answered: {folder.picture}", flush=True)

    return Errand(_in_one_line("train", train), kept=KEPT, close=live.close)


def _replay(values: argparse.Namespace) -> Work:
    folder = _folder(values)

    def replay() -> None:
        lines = training.replay_lessons(folder)
        with contextlib.closing(Database(folder.database)) as database:
            began = bool(database.rounds())
        if began:
            with contextlib.closing(Live(folder, {})) as live:
                lines.append(live.replay())
        print("\n".join(lines) or "nothing was trained yet")

    return Errand(_in_one_line("replay", replay))


# --- simulated participants, analysis ---------------------------------------------------------------------------------------


def _simulate_flags(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("number", type=int, metavar="N", help="synthetic participants of each phase")
    parser.add_argument("--phase", default="both", metavar="PHASE", help="training, testing or both [both]")
    parser.add_argument("--seed", default=0, help="of who they are, and of their chance [0]", **options(0))
    parser.add_argument("--seeds", default=SEEDS, help=f"agents of each method [{SEEDS}]", **options(SEEDS))
    parser.add_argument("--total-steps", default=None, help="environment steps of a training", **options(1))


def _simulate(values: argparse.Namespace) -> Work:
    folder = _folder(values)
    if values.phase not in ("training", "testing", "both"):
        raise ValueError(f"phase {values.phase!r} is unknown: choose training, testing or both")
    if not 1 <= values.number <= 1_000:
        raise ValueError(f"number {values.number} is out of range: choose 1 to 1000")
    serving = Serving(Study(folder))
    database = serving.study.database
    if not database.noted("simulated") and any(one.consented for one in database.participants()):
        serving.close()
        raise ValueError(f"out {values.out!r} holds what people have said: simulate in a study of its own")

    def simulate() -> None:
        database.note("simulated", True)
        changes = {} if values.total_steps is None else {"total_steps": values.total_steps}
        lessons = [Lesson(method, tuple(range(values.seeds)), 3, changes) for method in experiment.RATED]
        with serving.in_background():
            if values.phase != "testing":
                _sit(serving, "training", values)
            if values.phase == "both" and not database.scenes():
                training.teach(folder, lessons, analysis.left_out(folder, "training"), _say)
            if values.phase != "training":
                _sit(serving, "testing", values)
                _say(analysis.planned(folder))

    return Errand(_in_one_line("simulate", simulate), kept="what was answered is kept", close=serving.close)


def _sit(serving: Serving, phase: str, values: argparse.Namespace) -> None:
    """Synthetic participants go through a phase."""
    settings = serving.study.settings
    env, seed = (settings.test_env, values.seed + 1) if phase == "testing" else (settings.env, values.seed)
    _say(f"{values.number} synthetic participants in the {phase} phase, at {serving.address}")
    people = simulated_participants.take_seats(serving.study.database, serving.address, env, phase, values.number, seed)
    simulated_participants.take_part(people)


def _analyse(values: argparse.Namespace) -> Work:
    folder = _folder(values)

    def analyse() -> None:
        written = analysis.write(folder)
        print(written[0].read_text(encoding="utf-8"))
        print(f"in {written[0].parent}: {', '.join(path.name for path in written)}")

    return Errand(_in_one_line("analyse", analyse))


def _say(line: str) -> None:
    print(line, file=sys.stderr, flush=True)


_NO_FLAGS = lambda parser: None
ACTIONS: dict[str, Action] = {
    "label": Action("one person here answers, and an agent learns meanwhile", _label_flags, _label, computes=True),
    "train": Action(
        "agents from the answers that are there, or with people in the loop", _train_flags, _train, computes=True
    ),
    "replay": Action("trains again from the answers, and says what differs", _NO_FLAGS, _replay, computes=True),
    "simulate": Action("a dry run with synthetic participants", _simulate_flags, _simulate, computes=True),
    "analyse": Action("statistics, tables and figures", _NO_FLAGS, _analyse),
}
