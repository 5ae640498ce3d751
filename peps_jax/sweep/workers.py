"""A sweep over several processes, on one machine or many, with one results folder that all of them see.

Runs are independent, so they are divided between the processes, and not laid over one mesh of all devices: each process
trains its batches on its own devices, as if it were alone. No collective waits for another machine, machines may differ, and
one that fails takes nothing with it. They come together once (`peps_jax.sweep.meeting`); after that they only share the folder,
where each leaves signs of life, and every process is a plain JAX program.
"""

from __future__ import annotations

import contextvars
import json
import os
import threading
import time
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from peps_jax.command_line import StoppedError
from peps_jax.execution.checkpoints import IncompatibleError
from peps_jax.execution.waiting import print_line
from peps_jax.storage import files
from peps_jax.sweep.journal import FOLDER

BEAT = 5.0  # s between two signs of life
SILENCE = 60.0  # s without one after which a process is taken for dead
LATE = 30.0  # s by which a shared folder may show a file later than another one
RUNNING, DONE, STOPPED, FAILED = "running", "done", "stopped", "failed"


class Team(NamedTuple):
    """The processes of a sweep, and which one this is."""

    index: int = 0
    count: int = 1
    run: str = ""  # the same for all, and another one every time
    neighbours: int = 1  # processes on this machine, this one included
    accelerators: str = ""  # that this one may use, where a cluster gives each process its own

    @property
    def leads(self) -> bool:
        """Whether this process makes the tables of all."""
        return self.index == 0

    @property
    def name(self) -> str:
        return f"process {self.index}" if self.count > 1 else ""


def alone() -> Team:
    """The team of a sweep in one process."""
    return Team(run=os.urandom(8).hex())


def numbered(indices: Sequence[int]) -> str:
    """Processes as a sentence names them: `process 2`, `processes 1, 2 and 5`; of many the first ones."""
    if not indices:
        return "no process"
    shown = [*map(str, indices[:8]), *([f"{len(indices) - 8} more"] if len(indices) > 8 else [])]
    names = " and ".join([", ".join(shown[:-1]), shown[-1]] if len(shown) > 1 else shown)
    return f"process{'es' * (len(indices) > 1)} {names}"


class Life:
    """Tells the others, by a file in the sweep's folder, that this process is at work; and how it ended.

    Meanwhile it says on stderr which of the others doesn't go on: process 0 watches all, the others watch process 0. It is silent
    once the folder is another sweep's.
    """

    def __init__(self, folder: Path, team: Team):
        self._path = _path(folder, team.index)
        self._team, self._beats = team, 0
        self.others = Others(folder, team, range(1, team.count) if team.leads else (0,))
        self._over = threading.Event()
        self._thread: threading.Thread | None = None
        self._told = {"status": RUNNING, "reason": ""}

    def __enter__(self) -> Life:
        """From now on there is a sign of life every `BEAT` seconds."""
        if self._team.count > 1:
            self._tell()
            # in a copy of the context, for the thread writes as this one does: for the folder's owner
            beat = contextvars.copy_context().run
            self._thread = threading.Thread(target=beat, args=(self._beat,), daemon=True)
            self._thread.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: object) -> None:
        """Tells how it ended."""
        if error is None:
            self._end(DONE, "")
        elif isinstance(error, KeyboardInterrupt | StoppedError):
            self._end(STOPPED, "asked to")
        else:
            plain = isinstance(error, files.NotWrittenError | IncompatibleError)  # which speak for themselves
            self._end(FAILED, f"{'' if plain else f'{kind.__name__}: '}{error}".splitlines()[0])

    def _end(self, status: str, reason: str) -> None:
        if self._thread is not None and not self._over.is_set():
            self._over.set()
            self._thread.join()
            self._told = {"status": status, "reason": reason}
            self._tell()

    def _beat(self) -> None:
        while not self._over.wait(BEAT):
            self._tell()
            for index, end in self.others.news().items():
                doing = "the others go on, and --resume does what is left" if self._team.leads else "this one goes on"
                print_line(f"{self._team.name}: process {index} doesn't go on ({end}); {doing}")

    def _tell(self) -> None:
        self._beats += 1
        told = self._told | {"run": self._team.run, "beat": self._beats}
        try:
            files.write_whole(self._path, files.json_bytes(told))
        except files.OwnershipLostError:
            self._over.set()  # the sweep finds out by itself, and says so
        except files.NotWrittenError as error:
            # no reason to stop: whoever writes what counts complains; and a sweep that is complete has no such folder
            if self._path.parent.exists():
                print_line(f"no sign of life: {error}")


class Others:
    """Other processes, as their signs of life tell.

    Args:
      folder: of the sweep.
      team: that this process is one of.
      watched: numbers of the processes; all but this one by default.
    """

    def __init__(self, folder: Path, team: Team, watched: Iterable[int] | None = None):
        self._folder, self._team = folder, team
        now = time.monotonic()
        watched = range(team.count) if watched is None else watched
        self._seen = {index: (0, now) for index in watched if index != team.index}  # beat, and when it came
        self._known: set[int] = set()  # to have ended

    def ends(self) -> dict[int, str]:
        """How those that don't run any more have ended: DONE, or what went wrong."""
        ends = {}
        for index, (beat, when) in self._seen.items():
            told = self._told(index)
            if told["beat"] != beat:
                self._seen[index] = told["beat"], time.monotonic()
            elif told["status"] == RUNNING and time.monotonic() - when > SILENCE:
                ends[index] = f"no sign of life for {SILENCE:.0f} s"
            if told["status"] != RUNNING:
                ends[index] = DONE if told["status"] == DONE else f"{told['status']}: {told['reason']}"
        return ends

    def news(self) -> dict[int, str]:
        """What went wrong with those that have ended since the last call."""
        ends = {index: end for index, end in self.ends().items() if index not in self._known}
        self._known |= ends.keys()
        return {index: end for index, end in ends.items() if end != DONE}

    def _told(self, index: int) -> dict[str, Any]:
        nothing = {"status": RUNNING, "beat": 0, "run": self._team.run, "reason": ""}
        try:
            told = json.loads(_path(self._folder, index).read_text(encoding="utf-8"))
        except (OSError, ValueError):
            return nothing
        return told if told["run"] == self._team.run else nothing  # an earlier run's


def _path(folder: Path, index: int) -> Path:
    return folder / FOLDER / f"process-{index:05d}.json"
