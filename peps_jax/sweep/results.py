"""A sweep's results folder: written batch by batch, each file whole or not at all, and read back run by run.

    manifest.json    command, settings, versions, devices, times, rows
    results.csv      a row for each combination of environment, method, lambda and seed
    curves.npz       `env_steps` (rounds,), and every curve (rows, rounds) in the order of the rows; nan where a method has none
    answers/*.npz    what each training's teacher said, where that was asked for; see `peps_jax.preferences.data`
    runs/*.msgpack   what each training learned and how it was evaluated, behind a line with the file's checksum
    *.png            pictures, see `peps_jax.sweep.pictures`
    progress/        how far an unfinished sweep is, see `peps_jax.sweep.journal`
    .owner/          whose the folder is while it is written, see `peps_jax.storage.ownership`

A method that doesn't use lambda is trained once for each environment and seed; its rows for the grid's lambdas share that
training's numbers and file.
"""

from __future__ import annotations

import csv
import dataclasses
import difflib
import io
import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import flax.serialization
import jax
import numpy as np

from peps_envs.registry import unknown_name
from peps_jax.config import Config
from peps_jax.evaluate import Evaluation
from peps_jax.execution import machine
from peps_jax.execution.program import FinishedRun, Times, empty_finished
from peps_jax.preferences import data
from peps_jax.storage import files
from peps_jax.storage.tables import csv_bytes
from peps_jax.train import Result, init, prepare

MANIFEST, TABLE, CURVES, RUNS, ANSWERS = "manifest.json", "results.csv", "curves.npz", "runs", "answers"
PICTURES = ("learning_curves.png", "frontier.png", "routes.png", "surrogate.png")
KEYS = ("env", "method", "lam", "seed")  # what tells rows apart


class Key(NamedTuple):
    """What a row of the table shows."""

    env: str
    method: str
    lam: float
    seed: int
    training: str  # name of the training; several rows share one where the method doesn't use lambda

    @property
    def name(self) -> str:
        return f"{self.env}-{self.method}-lam{self.lam}-seed{self.seed}"

    @property
    def file(self) -> str:
        return f"{RUNS}/{self.training}.msgpack"


class Row(NamedTuple):
    """A row of the table, and the run that it shows."""

    key: Key
    run: FinishedRun


def holds_results(folder: Path) -> bool:
    """Whether a sweep has written into `folder`."""
    return any((folder / name).exists() for name in (MANIFEST, TABLE))


def check_free(folder: Path) -> None:
    """Raises ValueError if a sweep has written into `folder`."""
    if holds_results(folder):
        raise ValueError(
            f"out {str(folder)!r} holds another run's results: choose another folder, add --overwrite to replace them, "
            "or --resume to continue"
        )


def is_complete(folder: Path) -> bool:
    """Whether the sweep in `folder` has nothing left to do."""
    try:
        return json.loads((folder / MANIFEST).read_text(encoding="utf-8")).get("status") == "complete"
    except (OSError, ValueError):
        return False


def all_failed(folder: Path) -> bool:
    """Whether no row of the sweep in `folder` has numbers that are finite."""
    try:
        table = (folder / TABLE).read_text(encoding="utf-8")
    except OSError:
        return False
    return all(row["status"] == "failed" for row in csv.DictReader(io.StringIO(table)))


def summary(evaluation: Evaluation) -> dict[str, float]:
    """The numbers of a row: means over episodes; of each event the rate, e.g. `goal_rate` of `goal_reached`."""
    mean = lambda values: float(np.mean(values))
    spread = lambda values: float(np.std(values))
    return {
        "return_mean": mean(evaluation.return_),
        "return_std": spread(evaluation.return_),
        "explicability_mean": mean(evaluation.explicability),
        "explicability_std": spread(evaluation.explicability),
        "belief_gap_mean": mean(evaluation.belief_gap),
        "human_return_mean": mean(evaluation.human_return),
        "length_mean": mean(evaluation.length),
        "explicability_with_policy_mean": mean(evaluation.explicability_with_policy),
    } | {f"{name.removesuffix('_reached')}_rate": mean(values) for name, values in evaluation.events.items()}


def record(row: Row) -> dict[str, Any]:
    """A row of the table."""
    key = row.key
    status = "failed" if row.run.failed else "ok"
    return (
        {name: getattr(key, name) for name in KEYS}
        | {"status": status}
        | summary(row.run.evaluation)
        | {"name": key.name}
    )


# --- writing --------------------------------------------------------------------------------------------------------------


def write_answers(folder: Path, training: str, run: FinishedRun) -> None:
    """Writes what a training's teacher said, if it had one. Raises NotWrittenError."""
    if run.preferences is not None:
        files.make_folder(folder / ANSWERS)
        data.save(folder / ANSWERS / f"{training}.npz", run.preferences)


def write_run(folder: Path, training: str, run: FinishedRun) -> str:
    """Writes what a training left; returns the file's checksum. Raises NotWrittenError."""
    path = folder / RUNS / f"{training}.msgpack"
    files.make_folder(path.parent)
    content = files.seal(_learned(run))
    files.write_whole(path, content)
    return files.digest(content)


class Writer:
    """Writes what a sweep's folder tells of its finished runs. `save` may come at any time; the folder is valid after each.

    Raises:
      NotWrittenError: there is no room, or no permission.
    """

    def __init__(self, folder: Path, command: str, settings: Mapping[str, Any]):
        self.folder = folder
        self._head = {"command": command, "configuration": files.plain(settings)} | machine.describe()

    def save(self, rows: Sequence[Row], times: Times, env_steps: int, status: str) -> None:
        """Writes the tables of the rows finished so far; `status` is "running", "complete" or "interrupted"."""
        files.make_folder(self.folder)
        if rows:
            files.write_whole(self.folder / CURVES, _curves(rows))
            files.write_whole(self.folder / TABLE, csv_bytes([record(row) for row in rows]))
        manifest = self._head | {
            "status": status,
            "compile_seconds": round(times.compile, 3),
            "run_seconds": round(times.run, 3),  # of training
            "evaluation_seconds": round(times.evaluate, 3),
            "env_steps": env_steps,
            "env_steps_per_second": round(env_steps / times.run, 1) if times.run else 0.0,
            "rows": [_entry(row) for row in rows],
        }
        files.write_whole(self.folder / MANIFEST, files.json_bytes(manifest))


def clear(folder: Path) -> None:
    """Removes a sweep's files; others stay. The manifest goes first: without it nothing is taken for results."""
    for name in (MANIFEST, TABLE, CURVES, *PICTURES):
        files.remove(folder / name)
    for path in (*(folder / RUNS).glob("*.msgpack"), *(folder / ANSWERS).glob("*.npz")):
        files.remove(path)


def _entry(row: Row) -> dict[str, Any]:
    """A row in the manifest."""
    key = row.key
    return {"name": key.name} | {name: getattr(key, name) for name in KEYS} | {"file": key.file}


def _learned(run: FinishedRun) -> bytes:
    """What a training leaves; the environment's numbers too, so that it is evaluated in the one that it was trained in."""
    problem = run.config.problem()
    parts = {
        "agents": run.agents,
        "knowledge": run.knowledge,
        "curves": run.curves,
        "params": _numbered(problem.params),
        "belief": _numbered(problem.belief),
        "evaluation": run.evaluation,
        "failed": run.failed,
    }
    return flax.serialization.to_bytes(jax.tree.map(np.asarray, parts))


def _numbered(tree: Any) -> dict[str, Any]:
    """The leaves of a tree, whatever it is made of: parameters may be another ecosystem's, such as a MuJoCo model."""
    return {str(place): leaf for place, leaf in enumerate(jax.tree.leaves(tree))}


def _like(tree: Any, numbered: Mapping[str, Any]) -> Any:
    """What `_numbered` was given, of the structure of `tree`."""
    return jax.tree.unflatten(jax.tree.structure(tree), [numbered[str(place)] for place in range(len(numbered))])


def read_run(folder: Path, training: str, config: Config, num_episodes: int, checksum: str) -> FinishedRun:
    """What `write_run` was given.

    Raises:
      DamagedError: the file isn't the one with that checksum.
    """
    try:
        content = (folder / RUNS / f"{training}.msgpack").read_bytes()
    except OSError:
        raise files.DamagedError("it is missing") from None
    if files.digest(content) != checksum:
        raise files.DamagedError("its checksum is wrong")
    stored = flax.serialization.msgpack_restore(files.unseal(content))
    empty, evaluation = empty_finished(config, num_episodes)
    restore = flax.serialization.from_state_dict
    return FinishedRun(
        training=prepare(config),
        agents=restore(empty.agents, stored["agents"]),
        knowledge=restore(empty.knowledge, stored["knowledge"]),
        preferences=None,
        curves=stored["curves"],
        evaluation=restore(evaluation, stored["evaluation"]),
        failed=bool(stored["failed"]),
    )


def _curves(rows: Sequence[Row]) -> bytes:
    names = sorted({name for row in rows for name in row.run.curves})
    config = rows[0].run.config
    nothing = np.full(config.num_rounds, np.nan, np.float32)
    curves = {name: np.stack([row.run.curves.get(name, nothing) for row in rows]) for name in names}
    env_steps = config.steps_per_round * np.arange(1, config.num_rounds + 1)
    buffer = io.BytesIO()
    np.savez_compressed(buffer, env_steps=env_steps, **curves)
    return buffer.getvalue()


# --- reading --------------------------------------------------------------------------------------------------------------


def load(folder: str | os.PathLike[str], row: int | str | Mapping[str, Any]) -> Result:
    """A row of a sweep, ready to act: `load("results/sweep", "nav-d1-peps-lam2.4-seed0").act(observation)`.

    Args:
      folder: that the sweep wrote.
      row: its number in results.csv, from 0; or its name, the column `name`; or what tells it apart, e.g. {"env": "nav-d1",
        "method": "peps", "seed": 0}.

    Raises:
      ValueError: no results there, no such row, more than one, or a file that this version can't read.
    """
    folder = Path(folder)
    try:
        manifest = json.loads((folder / MANIFEST).read_text(encoding="utf-8"))
        rows, configuration = manifest["rows"], manifest["configuration"]
    except (OSError, ValueError):
        raise ValueError(f"folder {str(folder)!r} holds no sweep's results: {MANIFEST} is missing or broken") from None
    except KeyError as error:
        raise ValueError(
            f"folder {str(folder)!r} was written by a version that doesn't fit this one: no {error}"
        ) from None
    entry = _find(rows, row)
    config = _config(configuration, entry)
    problem = config.problem()
    shapes = jax.eval_shape(lambda config: init(prepare(config)), config)
    numbers = {"params": problem.params, "belief": problem.belief}
    empty = {"agents": shapes.agents, "knowledge": shapes.knowledge} | {
        name: _numbered(tree) for name, tree in numbers.items()
    }
    path = folder / entry["file"]
    try:
        content = path.read_bytes()
        stored = flax.serialization.msgpack_restore(files.unseal(content) if files.is_sealed(content) else content)
        curves = stored.pop("curves")
        stored = {name: value for name, value in stored.items() if name in empty}
        parts = flax.serialization.from_state_dict(empty, stored)
    except OSError:
        raise ValueError(f"file {str(path)!r} is missing: the folder is incomplete; run the sweep again") from None
    except files.DamagedError as error:
        raise ValueError(f"file {str(path)!r} is damaged ({error}): run the sweep again") from None
    except (ValueError, KeyError) as error:
        reason = str(error).splitlines()[0]
        raise ValueError(f"file {str(path)!r} was written by a version that doesn't fit this one: {reason}") from None
    config = config.replace(**{name: _like(tree, parts[name]) for name, tree in numbers.items()})
    answers = folder / ANSWERS / f"{path.stem}.npz"
    preferences = data.load(answers) if answers.exists() else None
    return Result(prepare(config), parts["agents"], parts["knowledge"], preferences, curves)


def _find(rows: Sequence[Mapping[str, Any]], wanted: int | str | Mapping[str, Any]) -> Mapping[str, Any]:
    """The manifest's entry of a row."""
    if isinstance(wanted, Mapping):
        for key in wanted:
            if key not in KEYS:
                raise ValueError(unknown_name("key", key, KEYS))
        found = [entry for entry in rows if all(entry[key] == value for key, value in wanted.items())]
        if len(found) != 1:
            told = ", ".join(entry["name"] for entry in (found or rows)[:4])
            more = " ..." if len(found or rows) > 4 else ""
            raise ValueError(f"row {dict(wanted)!r} matches {len(found)} of {len(rows)} rows, not one: {told}{more}")
        return found[0]
    if isinstance(wanted, str):
        by_name = {entry["name"]: entry for entry in rows}
        if wanted not in by_name:
            nearest = difflib.get_close_matches(wanted, by_name, n=3, cutoff=0)
            raise ValueError(f"row {wanted!r} is unknown: of {len(rows)} rows the nearest are {', '.join(nearest)}")
        return by_name[wanted]
    if not 0 <= wanted < len(rows):
        raise ValueError(f"row {wanted} is out of range: choose 0 to {len(rows) - 1}")
    return rows[wanted]


def _config(configuration: Mapping[str, Any], entry: Mapping[str, Any]) -> Config:
    """A row's `Config`: the sweep's settings, and what is the row's own."""
    own = {key: value for key, value in entry.items() if key in KEYS}
    values = tuples({name: value for name, value in configuration.items() if name not in KEYS} | own)
    names = {
        field.name for field in dataclasses.fields(Config)
    }  # an older folder may lack one, a newer one may have more
    return Config(**{name: value for name, value in values.items() if name in names})


def tuples(configuration: Mapping[str, Any]) -> dict[str, Any]:
    """Settings as `plain` was given them: lists are tuples again, text for a number is one."""
    defaults = {field.name: field.default for field in dataclasses.fields(Config)}
    values = {}
    for name, value in configuration.items():
        if isinstance(defaults.get(name), float) and isinstance(value, str):
            value = float(value)
        values[name] = tuple(value) if isinstance(value, list) else value
    return values
