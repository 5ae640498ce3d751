"""A sweep's results folder: written batch by batch, each file whole or not at all, and read back cell by cell.

    manifest.json    command, settings, versions, devices, times, cells
    results.csv      one row for each cell of the grid
    curves.npz       `env_steps` (rounds,), and every curve (cells, rounds) in the order of the rows; nan where a method has none
    cells/*.msgpack  what each training learned
    *.png            pictures, see `peps_jax.plots`

A method that doesn't use lambda is trained once for each environment and seed; its rows for the grid's lambdas share that
training's numbers and file.
"""

from __future__ import annotations

import csv
import dataclasses
import difflib
import importlib.metadata
import io
import json
import math
import os
import platform
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import flax.serialization
import jax
import numpy as np

from peps_envs.registry import unknown_name
from peps_jax.batch import Finished, Times
from peps_jax.config import Config
from peps_jax.evaluate import Evaluation
from peps_jax.train import Result, init

MANIFEST, TABLE, CURVES, CELLS = "manifest.json", "results.csv", "curves.npz", "cells"
PACKAGES = ("peps-jax", "jax", "jaxlib", "flax", "optax", "distrax", "chex", "numpy")
PICTURES = ("learning_curves.png", "frontier.png", "routes.png", "surrogate.png")
KEYS = ("env", "method", "lam", "seed")  # what tells a grid's cells apart


class Cell(NamedTuple):
    """A row of the grid, and the training that it shows."""

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
        return f"{CELLS}/{self.training}.msgpack"


class Row(NamedTuple):
    """A finished cell."""

    cell: Cell
    finished: Finished


def holds_results(folder: Path) -> bool:
    """Whether a sweep has written into `folder`."""
    return any((folder / name).exists() for name in (MANIFEST, TABLE))


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
    cell = row.cell
    status = "failed" if row.finished.failed else "ok"
    return (
        {key: getattr(cell, key) for key in KEYS}
        | {"status": status}
        | summary(row.finished.evaluation)
        | {"cell": cell.name}
    )


# --- writing --------------------------------------------------------------------------------------------------------------


def write_whole(path: Path, content: bytes) -> None:
    """Writes a file so that a reader sees the old one or the new one, never a half."""
    with tempfile.NamedTemporaryFile(dir=path.parent, prefix=f".{path.name}.", delete=False) as file:
        try:
            file.write(content)
            file.flush()
            os.chmod(file.name, 0o644)  # a temporary file is its owner's alone
            os.replace(file.name, path)
        except BaseException:
            os.unlink(file.name)
            raise


class Writer:
    """Writes a sweep's folder. `save` may come after every batch; what it wrote stays valid if nothing follows."""

    def __init__(self, folder: Path, command: str, settings: Mapping[str, Any]):
        self.folder = folder
        self._head = {"command": command, "configuration": plain(settings)} | machine()
        self._trainings: set[str] = set()

    def save(self, rows: Sequence[Row], times: Times, env_steps: int, status: str) -> None:
        """Writes the rows finished so far; `status` is "running", "complete" or "interrupted".

        The first time, it takes the place of what an earlier sweep wrote here; other files stay.
        """
        if not self._trainings:
            _clear(self.folder)
        (self.folder / CELLS).mkdir(parents=True, exist_ok=True)
        for row in rows:
            if row.cell.training not in self._trainings:
                write_whole(self.folder / row.cell.file, _learned(row.finished.result))
                self._trainings.add(row.cell.training)
        write_whole(self.folder / CURVES, _curves(rows))
        write_whole(self.folder / TABLE, table([record(row) for row in rows]))
        manifest = self._head | {
            "status": status,
            "compile_seconds": round(times.compile, 3),
            "run_seconds": round(times.run, 3),  # of training
            "evaluation_seconds": round(times.evaluate, 3),
            "env_steps": env_steps,
            "env_steps_per_second": round(env_steps / times.run, 1) if times.run else 0.0,
            "cells": [_entry(row) for row in rows],
        }
        write_whole(self.folder / MANIFEST, (json.dumps(manifest, indent=1, allow_nan=False) + "\n").encode())


def _clear(folder: Path) -> None:
    """Removes an earlier sweep's files."""
    if holds_results(folder):
        for path in (folder / MANIFEST, folder / TABLE, folder / CURVES):
            path.unlink(missing_ok=True)
        for path in (*(folder / CELLS).glob("*.msgpack"), *(folder / name for name in PICTURES)):
            path.unlink(missing_ok=True)


def machine() -> dict[str, Any]:
    """Versions of what computes, and the devices."""
    versions = {"python": platform.python_version()}
    for package in PACKAGES:
        try:
            versions[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            versions[package] = "not installed"
    devices = [{"platform": device.platform, "kind": device.device_kind} for device in jax.devices()]
    return {"versions": versions, "devices": devices}


def plain(value: Any) -> Any:
    """`value` as JSON knows it; numbers that it doesn't, inf and nan, as text that `float` reads."""
    if isinstance(value, Mapping):
        return {key: plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)
    return value


def _entry(row: Row) -> dict[str, Any]:
    """A cell's place in the manifest."""
    cell = row.cell
    return {"name": cell.name} | {key: getattr(cell, key) for key in KEYS} | {"file": cell.file}


def _learned(result: Result) -> bytes:
    """What a training leaves; the world's numbers too, so that it is evaluated in the world it was trained in."""
    _, params, belief = result.config.task()
    parts = {
        "agents": result.agents,
        "knowledge": result.knowledge,
        "curves": result.curves,
        "params": params,
        "belief": belief,
    }
    return flax.serialization.to_bytes(jax.tree.map(np.asarray, parts))


def _curves(rows: Sequence[Row]) -> bytes:
    names = sorted({name for row in rows for name in row.finished.result.curves})
    config = rows[0].finished.result.config
    nothing = np.full(config.num_rounds, np.nan, np.float32)
    curves = {name: np.stack([row.finished.result.curves.get(name, nothing) for row in rows]) for name in names}
    env_steps = config.steps_per_round * np.arange(1, config.num_rounds + 1)
    buffer = io.BytesIO()
    np.savez_compressed(buffer, env_steps=env_steps, **curves)
    return buffer.getvalue()


def table(records: Sequence[Mapping[str, Any]]) -> bytes:
    """`records` as CSV; a column for every name that any of them has."""
    columns = list(dict.fromkeys(name for line in records for name in line))  # worlds may differ in their events
    buffer = io.StringIO()
    writer = csv.DictWriter(buffer, columns, lineterminator="\n")
    writer.writeheader()
    writer.writerows(records)
    return buffer.getvalue().encode()


# --- reading --------------------------------------------------------------------------------------------------------------


def load(folder: str | os.PathLike[str], cell: int | str | Mapping[str, Any]) -> Result:
    """A cell of a sweep, ready to act: `load("results/sweep", "nav-d1-peps-lam2.4-seed0").act(observation)`.

    Args:
      folder: that the sweep wrote.
      cell: its row in results.csv, from 0; or its name, the column `cell`; or what tells it apart, e.g. {"env": "nav-d1",
        "method": "peps", "seed": 0}.

    Raises:
      ValueError: no results there, no such cell, more than one, or a file that this version can't read.
    """
    folder = Path(folder)
    try:
        manifest = json.loads((folder / MANIFEST).read_text())
        cells, configuration = manifest["cells"], manifest["configuration"]
    except (OSError, ValueError, KeyError):
        raise ValueError(f"folder {str(folder)!r} holds no sweep's results: {MANIFEST} is missing or broken") from None
    entry = _find(cells, cell)
    config = _config(configuration, entry)
    _, params, belief = config.task()
    shapes = jax.eval_shape(init, config)
    empty = {"agents": shapes.agents, "knowledge": shapes.knowledge, "params": params, "belief": belief}
    path = folder / entry["file"]
    try:
        stored = flax.serialization.msgpack_restore(path.read_bytes())
        curves = stored.pop("curves")
        parts = flax.serialization.from_state_dict(empty, stored)
    except OSError:
        raise ValueError(f"file {str(path)!r} is missing: the folder is incomplete; run the sweep again") from None
    except (ValueError, KeyError) as error:
        reason = str(error).splitlines()[0]
        raise ValueError(f"file {str(path)!r} was written by a version that doesn't fit this one: {reason}") from None
    config = config.replace(params=parts["params"], belief=parts["belief"])
    return Result(agents=parts["agents"], knowledge=parts["knowledge"], curves=curves, config=config)


def _find(cells: Sequence[Mapping[str, Any]], wanted: int | str | Mapping[str, Any]) -> Mapping[str, Any]:
    """The manifest's entry of a cell."""
    if isinstance(wanted, Mapping):
        for key in wanted:
            if key not in KEYS:
                raise ValueError(unknown_name("key", key, KEYS))
        found = [entry for entry in cells if all(entry[key] == value for key, value in wanted.items())]
        if len(found) != 1:
            told = ", ".join(entry["name"] for entry in (found or cells)[:4])
            more = " ..." if len(found or cells) > 4 else ""
            raise ValueError(f"cell {dict(wanted)!r} matches {len(found)} of {len(cells)} cells, not one: {told}{more}")
        return found[0]
    if isinstance(wanted, str):
        by_name = {entry["name"]: entry for entry in cells}
        if wanted not in by_name:
            nearest = difflib.get_close_matches(wanted, by_name, n=3, cutoff=0)
            raise ValueError(f"cell {wanted!r} is unknown: of {len(cells)} cells the nearest are {', '.join(nearest)}")
        return by_name[wanted]
    if not 0 <= wanted < len(cells):
        raise ValueError(f"cell {wanted} is out of range: choose 0 to {len(cells) - 1}")
    return cells[wanted]


def _config(configuration: Mapping[str, Any], entry: Mapping[str, Any]) -> Config:
    """A cell's `Config`: the sweep's settings, and what is the cell's own. Lists are tuples again, text for a number is one."""
    values = {}
    for field in dataclasses.fields(Config):
        source = entry if field.name in KEYS else configuration
        if field.name in source:  # an older folder may lack a setting, a newer one may have more
            value = source[field.name]
            if isinstance(field.default, float) and isinstance(value, str):
                value = float(value)
            values[field.name] = tuple(value) if isinstance(value, list) else value
    return Config(**values)
