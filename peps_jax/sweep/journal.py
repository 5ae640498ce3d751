"""How far a sweep is: its plan, the batches that are done, and checkpoints of those under way; in its folder's `progress/`.

    plan.json                     what the sweep is about, its batches, and who runs which; sealed
    batch-00003.json              batch 3 is done: the checksums of its runs' files, and what it took; sealed
    batch-00003/rounds-00000040/  a checkpoint of it, see `peps_jax.execution.checkpoints`
    process-00001.json            a sign of life, see `peps_jax.sweep.workers`

A batch is done once its file is there: it comes last, after those of its runs. Tables and pictures can be made of these files
at any time. The folder is removed when the sweep is complete.
"""

from __future__ import annotations

import contextlib
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from peps_jax.config import Config
from peps_jax.execution.checkpoints import FORMAT, Checkpoints
from peps_jax.execution.program import FinishedRun, Times, shared
from peps_jax.preferences.data import PreferenceSet
from peps_jax.storage import files, ownership
from peps_jax.sweep import results

FOLDER, PLAN = "progress", "plan.json"


class Planned(NamedTuple):
    """A batch by its trainings' names."""

    trainings: tuple[str, ...]
    slots: int


class Plan(NamedTuple):
    """A sweep's batches, and who runs which of them."""

    batches: tuple[Planned, ...]
    shares: tuple[tuple[int, ...], ...]  # numbers of batches, of each process
    run: str  # that shared them out last


class Done(NamedTuple):
    """A batch that is done."""

    runs: dict[str, str]  # checksums of the files, by training
    times: Times


class Journal:
    """The progress of the sweep in `folder`.

    Args:
      about: what has to be the same for a sweep to be continued: versions, settings. JSON knows it.
      keeps_answers: whether what teachers said is kept.

    Raises:
      NotWrittenError: from whatever writes, if there is no room or no permission.
    """

    def __init__(self, folder: Path, about: Mapping[str, Any], keeps_answers: bool = False):
        self.folder = folder / FOLDER
        self._results = folder
        self._keeps_answers = keeps_answers
        self._about = {"format": FORMAT, **about}

    def begin(self, plan: Plan) -> None:
        """Writes the plan of a new sweep."""
        files.make_folder(self.folder)
        self.share_out(plan)

    def share_out(self, plan: Plan) -> None:
        """Writes a plan, and removes what processes that were killed have left."""
        files.remove_unfinished(self._results)
        content = self._about | {
            "run": plan.run,
            "batches": [{"trainings": one.trainings, "slots": one.slots} for one in plan.batches],
            "shares": plan.shares,
        }
        files.write_whole(self.folder / PLAN, files.seal(files.json_bytes(content)))

    def plan(self) -> Plan:
        """The sweep's plan.

        Raises:
          ValueError: there is none that this process could go on with; one line says why.
        """
        path = self.folder / PLAN
        try:
            stored = json.loads(files.unseal(path.read_bytes()))
        except OSError:
            raise ValueError(
                f"out {str(self._results)!r} holds no sweep that can be continued ({FOLDER}/{PLAN} is missing): "
                "choose another folder, or add --overwrite to start again"
            ) from None
        except files.DamagedError as error:
            raise ValueError(
                f"file {str(path)!r} is damaged ({error}): nothing can be continued; add --overwrite to start again"
            ) from None
        for name, value in self._about.items():
            if stored.get(name) != value:
                was, now = (str(it)[:12] for it in (stored.get(name), value))
                raise ValueError(
                    f"out {str(self._results)!r} was begun with {name} {was}, and this is {now}: "
                    "go on with what it was begun with, or start again with --overwrite"
                )
        batches = tuple(Planned(tuple(one["trainings"]), one["slots"]) for one in stored["batches"])
        return Plan(batches, tuple(map(tuple, stored["shares"])), stored["run"])

    def checkpoints(self, number: int, runs: Sequence[Config]) -> Checkpoints:
        """The checkpoints of batch `number`, whose runs are `runs`."""
        about = {name: value for name, value in self._about.items() if name != "format"}
        return Checkpoints(self.folder / _name(number), about | {"runs": numbers_digest(runs)})

    def commit(self, number: int, runs: Mapping[str, FinishedRun], times: Times) -> None:
        """Writes the runs' files, and then that batch `number` is done; it needs no checkpoint any more."""
        if self._keeps_answers:
            for training, finished in runs.items():
                results.write_answers(self._results, training, finished)
        sums = {training: results.write_run(self._results, training, finished) for training, finished in runs.items()}
        content = {"runs": sums, "times": times._asdict()}
        files.write_whole(self.folder / f"{_name(number)}.json", files.seal(files.json_bytes(content)))
        with contextlib.suppress(
            files.OwnershipLostError
        ):  # process 0 may be done with the folder by now, if this was all
            files.remove(self.folder / _name(number))

    def done(self, number: int) -> Done | None:
        """Batch `number`, or None if it isn't done.

        Raises:
          DamagedError: its file isn't what was written.
        """
        try:
            stored = json.loads(files.unseal((self.folder / f"{_name(number)}.json").read_bytes()))
        except OSError:
            return None
        return Done(stored["runs"], Times(**stored["times"]))


def is_open(folder: Path) -> bool:
    """Whether anything in `folder` tells of a sweep that is under way."""
    return (folder / FOLDER).exists() or bool(ownership.owners(folder)) or any(folder.glob(f"{files.TEMPORARY}*"))


def close(folder: Path) -> None:
    """Removes the progress of a sweep that is complete, and what processes that were killed have left. Raises NotWrittenError."""
    files.remove(folder / FOLDER)
    files.remove_unfinished(folder)


def clear(folder: Path) -> None:
    """Removes a sweep and its progress from `folder`; other files stay. Raises NotWrittenError."""
    results.clear(folder)
    files.remove(folder / FOLDER)


def numbers_digest(configs: Sequence[Config], preferences: PreferenceSet | None = None) -> str:
    """A checksum of all numbers that `configs` learn from, their environments' among them: a changed default is a changed one."""
    leaves = jax.tree.leaves([[shared(config) for config in configs], preferences])
    return files.digest(b"".join(np.asarray(leaf).tobytes() for leaf in leaves))


def _name(number: int) -> str:
    return f"batch-{number:05d}"
