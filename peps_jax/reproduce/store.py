"""What is kept of everything that takes long: one file for each, whole or not there.

    reproduce.json   what the folder is about: settings, code, seeds, versions, devices
    kept/*.npz       what came out of a training or a plan, and the digest of what made it

A folder holds one configuration. Another one's trainings, or those of other code, are never mixed with it or replaced.
"""

from __future__ import annotations

import dataclasses
import functools
import json
from collections.abc import Mapping
from contextlib import AbstractContextManager
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from peps_envs import Environment
from peps_jax.analysis.surrogate_maps import rank_correlation
from peps_jax.config import Config
from peps_jax.evaluate import Evaluation
from peps_jax.execution import machine
from peps_jax.storage import code, files
from peps_jax.storage.arrays import read_arrays, write_arrays
from peps_jax.storage.ownership import Owner, holds_nothing

HEAD, KEPT = "reproduce.json", "kept"
ROUTES = 3  # episodes of each training whose route is kept
# modules whose code, and that of all they import, decides a record's numbers beside its settings
CODE = ("peps_jax.train", "peps_jax.evaluate", "peps_jax.analysis.navigation_planner")


class Record(NamedTuple):
    """What is kept of a training, or of a plan."""

    # (episodes,) each: return, explicability, ... of the policy's mode, and believed_return, sum r_H in the human's own MDP
    mode: dict[str, np.ndarray]
    sampled: dict[str, np.ndarray]  # the same of its samples; nothing of a plan
    routes: np.ndarray  # (ROUTES, horizon + 1, 2) positions; the last one is repeated after the end
    heat: dict[str, np.ndarray]  # (rows, columns) each: learned, true, free; nothing without r-hat or without a map
    failed: bool  # something that was learned or evaluated isn't finite
    seconds: float  # of wall clock
    seen: Mapping[str, np.ndarray] = MappingProxyType({})  # by the training's view; nothing without one

    def mean(self, name: str, sampled: bool = False) -> float:
        """Mean over episodes."""
        return float(np.mean((self.sampled if sampled else self.mode)[name]))

    def rank_correlation(self) -> float:
        """Of r-hat and the true l_H + r_H over the map."""
        free = self.heat["free"]
        return rank_correlation(self.heat["learned"][free], self.heat["true"][free])

    def arrays(self) -> dict[str, np.ndarray]:
        """What a file holds of it."""
        arrays = {"routes": self.routes, "failed": np.array(self.failed), "seconds": np.array(self.seconds)}
        for part in ("mode", "sampled", "heat", "seen"):
            arrays |= {f"{part}/{key}": values for key, values in getattr(self, part).items()}
        return arrays

    @classmethod
    def of(cls, arrays: Mapping[str, np.ndarray]) -> Record:
        """What `arrays` were made of."""
        part = lambda name: {
            key.partition("/")[2]: value for key, value in arrays.items() if key.startswith(f"{name}/")
        }
        failed, seconds = bool(arrays["failed"]), float(arrays["seconds"])
        return cls(part("mode"), part("sampled"), arrays["routes"], part("heat"), failed, seconds, part("seen"))


def episodes(evaluation: Evaluation) -> dict[str, np.ndarray]:
    """The numbers of each episode, (episodes,) each."""
    figures = {
        "return": evaluation.return_,
        "explicability": evaluation.explicability,
        "explicability_with_policy": evaluation.explicability_with_policy,
        "belief_gap": evaluation.belief_gap,
        "human_return": evaluation.human_return,
        "length": evaluation.length,
    }
    return {name: np.asarray(values, np.float32) for name, values in (figures | evaluation.events).items()}


def settings_of(config: Config) -> dict[str, Any]:
    """Every setting, as JSON knows it."""
    return files.plain({field.name: getattr(config, field.name) for field in dataclasses.fields(Config)})


def code_of(environment: Environment) -> str | None:
    """A short name for an environment's code, where that of training and evaluation doesn't hold it; None where it does.

    A task's module may be imported when the task is made, which nothing tells that reads imports.
    """
    parts = (type(environment), *filter(callable, vars(environment).values()))
    modules = {part.__module__ for part in parts if part.__module__.split(".")[0] in code.PACKAGES}
    modules -= _covered()
    return code.digest(*sorted(modules))[:16] if modules else None


@functools.cache
def _covered() -> frozenset[str]:
    """Modules whose code `code_digest` is of."""
    return frozenset(code.closure(*CODE))


def code_digest() -> str:
    """A short name for the code that trains, evaluates and plans."""
    return code.digest(*CODE)[:16]


class Store:
    """A folder of records: who constructs one may read it, who opens it owns it.

    Raises:
      ValueError: the folder holds something else, or what other settings, other code or more seeds made.
    """

    def __init__(self, folder: Path, config: Config, num_episodes: int, seeds: int):
        self.folder = folder
        self._code = code_digest()
        self._episodes = num_episodes
        self._head = {"settings": settings_of(config) | {"episodes": num_episodes}, "code": self._code, "seeds": seeds}
        self._owner = Owner(folder)
        files.check_writable(folder)
        self._check()

    def _check(self) -> None:
        name, advice = f"out {str(self.folder)!r}", "choose another folder"
        if holds_nothing(self.folder):
            return
        try:
            head = json.loads((self.folder / HEAD).read_text(encoding="utf-8"))
            settings, code, seeds = head["settings"], head["code"], head["seeds"]
        except (OSError, ValueError, KeyError):
            raise ValueError(f"{name} isn't empty and holds no reproduction ({HEAD}): {advice}") from None
        for setting, value in self._head["settings"].items():
            if settings.get(setting) != value:
                raise ValueError(f"{name} was made with {setting} {settings.get(setting)}, not {value}: {advice}")
        if code != self._code:
            raise ValueError(f"{name} was made by other code (that of training, evaluation or environments): {advice}")
        if seeds > self._head["seeds"]:
            raise ValueError(
                f"{name} has tables of {seeds} seeds, more than {self._head['seeds']}: give --seeds {seeds} or more, or {advice}"
            )

    def open(self) -> None:
        """Takes the folder, from a run that was stopped or is elsewhere, too; makes it, and writes what it is about.

        Raises:
          ValueError: it holds something else by now, or somebody else takes it at this moment.
          NotWrittenError: it can't be made or written.
        """
        self._owner.claim(self._check, over=True)
        with self.writing():
            files.make_folder(self.folder / KEPT)
            files.write_whole(self.folder / HEAD, files.json_bytes(self._head | machine.describe()))

    def writing(self) -> AbstractContextManager[None]:
        """What is written into the folder meanwhile is written for its owner: OwnershipLostError if that is another run now."""
        return self._owner.writing()

    def close(self) -> None:
        """Gives the folder back."""
        self._owner.release()

    def _path(self, name: str) -> Path:
        return self.folder / KEPT / f"{name}.npz"

    def digest(self, recipe: Mapping[str, Any]) -> str:
        """What tells the record of `recipe` from any other: settings, code, and number of episodes."""
        return files.json_digest((recipe, self._code, self._episodes))[:16]

    def save(self, name: str, recipe: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> None:
        """Keeps arrays by their names. Raises OwnershipLostError if the folder isn't this run's any more."""
        with self.writing():
            write_arrays(self._path(name), self.digest(recipe), arrays)

    def load(self, name: str, recipe: Mapping[str, Any]) -> dict[str, np.ndarray] | None:
        """The arrays kept as `name`, or None if there are none.

        Raises:
          ValueError: they can't be read, or something other than `recipe` made them.
        """
        path = self._path(name)
        return read_arrays(path, self.digest(recipe)) if path.exists() else None
