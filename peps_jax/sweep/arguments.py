"""What a sweep's command line asks for: flags, the grid of rows that they make, and whether all of it makes sense."""

from __future__ import annotations

import argparse
import dataclasses
import itertools
import json
import os
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import peps_envs
from peps_jax import methods
from peps_jax.command_line import Parser, called, number, options, shown
from peps_jax.config import Config
from peps_jax.preferences import data, teachers
from peps_jax.preferences.data import PreferenceSet
from peps_jax.storage import files
from peps_jax.sweep import meeting, results
from peps_jax.sweep.results import Key
from peps_jax.train import check, prepare

PROG = called("peps_jax.sweep", "peps-sweep")
MOST = 100_000  # seeds, and evaluation episodes
GRID = ("env", "method", "lam")  # fields of which a sweep takes several values
DEMONSTRATION = {"env": ("nav-d1", "nav-d4"), "method": ("peps", "sac"), "lam": (2.4,)}

DESCRIPTION = """\
Trains every combination of environments, methods, lambdas and seeds, side by side on all
devices, and writes tables, curves, learned parameters and pictures into a folder.
Without flags: a demonstration of a few minutes."""

EPILOG = f"""\
A method that doesn't use lambda (any but peps) is trained once for each environment and seed; its row is
repeated for every lambda, so that the table holds the whole grid.

examples:
  {PROG}
  {PROG} --env nav-d1 nav-d4 --lam 2.0 2.4 2.8 --seeds 8 --out results/mine
  {PROG} --env nav-d2 --belief unbiased --hidden-sizes 128 128 --out results/wide"""

# how a sweep is run, and not what it is: these may change when it is continued
RUNNING = (
    "out", "overwrite", "resume", "checkpoint_every", "distributed", "coordinator", "processes", "process", "wait",
)  # fmt: skip

TITLES = {
    "task": "task",
    "objective": "objective, Eq. (6)",
    "run": "size of a training",
    "sac": "soft actor-critic",
    "models": "learned dynamics and surrogate reward",
    "queries": "preferences",
    "human": "the synthetic human",
}


class Flags(NamedTuple):
    """A command line, read and not yet understood."""

    arguments: tuple[str, ...]  # as they were typed
    given: dict[str, Any]  # of `settings`, those that it has
    settings: dict[str, Any]  # the value of every flag that decides what the sweep is
    running: dict[str, Any]  # and of those that decide how it is run


@dataclasses.dataclass(frozen=True)
class Request:
    """What a command line asks for, checked."""

    keys: list[Key]  # of the rows, in the order of the table
    trainings: dict[str, Config]  # by name; several rows may show one
    settings: dict[str, Any]  # as in `Flags`
    running: dict[str, Any]
    preferences: PreferenceSet | None  # recorded, from which all trainings learn
    resume: bool  # continue what the folder holds
    begun_by: str  # the command that began it, this one or an earlier one

    @property
    def out(self) -> Path:
        return Path(self.running["out"])

    @property
    def episodes(self) -> int:
        """Of an evaluation."""
        return self.settings["episodes"]

    @property
    def continued(self) -> str:
        """The command that continues."""
        return f"{PROG} --resume --out {shlex.quote(self.running['out'])}"


def parser() -> Parser:
    """The command line's parser, made of `Config`'s fields."""
    made = Parser(PROG, description=DESCRIPTION, epilog=EPILOG, add_help=False)
    group = made.add_argument_group("grid")
    texts = {
        "env": f"environments: {', '.join(peps_envs.names())}",
        "method": f"methods: {', '.join(methods.METHODS)}",
        "lam": "reconciliation parameters: weight of explicability against return",
    }
    for name in GRID:
        kind = {"type": number(float, 2.4), "metavar": "X"} if name == "lam" else {"metavar": "NAME"}
        values = DEMONSTRATION[name]
        group.add_argument(f"--{name}", nargs="+", default=values, help=f"{texts[name]} [{shown(values)}]", **kind)
    text = "seeds for each: --seed and those after it [2]"
    group.add_argument("--seeds", default=2, help=text, **options(2))

    group = made.add_argument_group("results")
    group.add_argument("--out", default="results/sweep", metavar="DIR", help="folder to write [results/sweep]")
    group.add_argument("--overwrite", action="store_true", help="replace the results that the folder holds")
    text = "evaluation episodes, by the policy's mode [100]"
    group.add_argument("--episodes", default=100, help=text, **options(100))
    text = "continue what the folder holds; other flags aren't needed, or have to agree"
    group.add_argument("--resume", action="store_true", help=text)
    text = "seconds between two checkpoints; 0 for as many as possible [60, or more where they take long]"
    group.add_argument("--checkpoint-every", default=60.0, help=text, **options(60.0))
    text = "keep what each run's teacher said, in the folder's answers/: a file is what --preferences takes"
    group.add_argument("--keep-answers", action="store_true", help=text)
    group.add_argument("-h", "--help", action="help", help="show this and exit")

    group = made.add_argument_group("several processes, with one results folder that all of them see")
    text = "this is one of them; Slurm and other clusters tell which"
    group.add_argument("--distributed", action="store_true", help=text)
    text = "where process 0 is reached, for processes that are started by hand"
    group.add_argument("--coordinator", metavar="HOST:PORT", help=text)
    group.add_argument("--processes", help="how many there are", **options(2))
    group.add_argument("--process", help="which one this is, from 0", **options(0))
    text = f"seconds to wait for the others to come and for process 0 to begin [{meeting.WAIT:g}]"
    group.add_argument("--wait", default=meeting.WAIT, help=text, **options(meeting.WAIT))

    groups = {name: made.add_argument_group(title) for name, title in TITLES.items()}
    text = "learn from these recorded answers, and ask nothing"
    groups["queries"].add_argument("--preferences", metavar="FILE", help=text)
    for field in dataclasses.fields(Config):
        if field.name in GRID or not field.metadata.get("flag", True):
            continue
        name = field.metadata.get("group", "other")
        if name not in groups:
            groups[name] = made.add_argument_group(name)
        text = field.metadata.get("help", "") + ("" if field.default is None else f" [{shown(field.default)}]")
        flag = f"--{field.name.replace('_', '-')}"
        groups[name].add_argument(flag, default=field.default, help=text.replace("%", "%%"), **options(field.default))
    return made


def _given(arguments: Sequence[str]) -> dict[str, Any]:
    """The flags of a command line, without those that it doesn't have."""
    made = parser()
    for action in made._actions:
        action.default = argparse.SUPPRESS
    return _hashable(vars(made.parse(arguments)))


def _hashable(settings: Mapping[str, Any]) -> dict[str, Any]:
    values = {name: tuple(value) if isinstance(value, list) else value for name, value in settings.items()}
    return values | {name: tuple(dict.fromkeys(values[name])) for name in GRID if name in values}


def read(arguments: Sequence[str]) -> Flags:
    """Reads a command line, and checks what decides how a sweep is run.

    Raises:
      ValueError: a value makes no sense; one line says which and what would be right.
      SystemExit: a flag that doesn't exist or can't be read (code 2), or --help (code 0).
    """
    given = _given(arguments)
    settings = _hashable(vars(parser().parse([]))) | given
    running = {name: settings.pop(name) for name in RUNNING}
    _check_running(running)
    given = {name: value for name, value in given.items() if name not in RUNNING}
    return Flags(tuple(arguments), given, settings, running)


def understood(asked: Flags) -> Request:
    """What a command line asks for. Raises ValueError for what makes no sense, or if the folder holds something else."""
    settings, running = asked.settings, asked.running
    out = Path(running["out"])
    stored, begun_by = _stored(out) if running["resume"] else (None, "")
    if stored is not None:
        _check_agreement(asked.given, stored, running["out"])
        settings = settings | {name: value for name, value in stored.items() if name in settings}
    elif running["resume"] and not asked.given:  # with other flags it is the first of many times that a script is run
        raise ValueError(
            f"out {running['out']!r} holds no sweep to continue ({results.MANIFEST} is missing): name its folder, "
            "or say with other flags what to begin"
        )
    for name in ("seeds", "episodes"):
        if not 1 <= settings[name] <= MOST:
            raise ValueError(f"{name} {settings[name]} is out of range: choose 1 to {MOST}")
    last = 2**31 - settings["seeds"]  # a seed is a 32-bit number
    if not 0 <= settings["seed"] <= last:
        raise ValueError(f"seed {settings['seed']} is out of range: choose 0 to {last}")
    keys, trainings = grid(settings)
    preferences = None
    if settings["preferences"] is not None:
        settings = settings | {"preferences": str(Path(settings["preferences"]).resolve())}
        preferences = _recorded(settings["preferences"], list(trainings.values()))
    if stored is None and not running["overwrite"]:
        results.check_free(out)
    files.check_writable(out)
    begun_by = begun_by or _as_text(shlex.join([*PROG.split(), *asked.arguments]))
    return Request(keys, trainings, settings, running, preferences, stored is not None, begun_by)


def _as_text(command: str) -> str:
    """A command as UTF-8 has it: a locale that knows ASCII alone took its words for bytes."""
    return os.fsencode(command).decode("utf-8", "surrogateescape")


def grid(settings: Mapping[str, Any]) -> tuple[list[Key], dict[str, Config]]:
    """The rows that `settings` ask for, and their trainings by name. Raises ValueError for settings that make no sense."""
    fields = [field.name for field in dataclasses.fields(Config) if field.name in settings and field.name not in GRID]
    fixed = {name: settings[name] for name in fields}
    keys, trainings = [], {}
    seeds = range(settings["seed"], settings["seed"] + settings["seeds"])
    for env, method, lam in itertools.product(*(settings[name] for name in GRID)):
        config = Config(**(fixed | {"env": env, "method": method, "lam": lam}))
        check(config)
        for seed in seeds:
            own = f"lam{lam}-" if methods.get(method).uses_lam else ""
            keys.append(Key(env, method, lam, seed, training=f"{env}-{method}-{own}seed{seed}"))
            trainings.setdefault(keys[-1].training, config.replace(seed=seed))
    return keys, trainings


def _recorded(file: str, configs: Sequence[Config]) -> PreferenceSet:
    """The preferences in `file`. Raises ValueError if they can't be read, or are of another environment than a training's."""
    preferences = data.load(file)
    asking = [config for config in configs if methods.get(config.method).asks]
    if not asking:
        names = ", ".join(name for name, method in methods.METHODS.items() if method.asks)
        raise ValueError(f"preferences {file!r} would teach nothing: of the methods only {names} learn from any")
    for config in {(config.env, config.method): config for config in asking}.values():
        teachers.recorded(preferences).check(True, prepare(config).settings, config.num_rounds)
    return preferences


def _stored(out: Path) -> tuple[dict[str, Any] | None, str]:
    """The settings of the sweep in `out`, None if there is none, and its command. Raises ValueError if they can't be read."""
    try:
        manifest = json.loads((out / results.MANIFEST).read_text(encoding="utf-8"))
        return results.tuples(manifest["configuration"]), manifest["command"]
    except (FileNotFoundError, NotADirectoryError):
        return None, ""
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        raise ValueError(
            f"out {str(out)!r} can't be continued: {results.MANIFEST} is broken; add --overwrite to start again"
        ) from None


def _check_agreement(asked: Mapping[str, Any], stored: Mapping[str, Any], out: str) -> None:
    for name, value in asked.items():
        if name not in stored or files.plain(stored[name]) != files.plain(value):
            raise ValueError(
                f"{name} {shown(value)} doesn't agree with what {out!r} was begun with, {shown(stored.get(name))}: "
                "leave that flag out, or choose another folder"
            )


def _check_running(running: Mapping[str, Any]) -> None:
    if running["resume"] and running["overwrite"]:
        raise ValueError("resume and overwrite can't both be: --resume continues, --overwrite starts again")
    if not running["checkpoint_every"] >= 0:
        raise ValueError(f"checkpoint_every {running['checkpoint_every']} is out of range: choose 0 or more seconds")
    if not 0 < running["wait"] < float("inf"):
        raise ValueError(f"wait {running['wait']:g} is out of range: choose more than 0 seconds")
    byhand = {name: running[name] for name in ("coordinator", "processes", "process")}
    missing = [name for name, value in byhand.items() if value is None]
    if 0 < len(missing) < len(byhand):
        raise ValueError(f"{missing[0]} is missing: --coordinator, --processes and --process belong together")
    if not missing:
        if not byhand["processes"] >= 1:
            raise ValueError(f"processes {byhand['processes']} is out of range: choose 1 or more")
        if not 0 <= byhand["process"] < byhand["processes"]:
            raise ValueError(f"process {byhand['process']} is out of range: choose 0 to {byhand['processes'] - 1}")
        host, _, port = byhand["coordinator"].rpartition(":")
        if not host or not port.isdigit():
            raise ValueError(f"coordinator {byhand['coordinator']!r} is no HOST:PORT, such as node7:12345")
