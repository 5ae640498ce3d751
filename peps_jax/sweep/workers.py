"""A sweep over several processes, on one machine or many, with one results folder that all of them see.

Cells are independent, so they are divided between the processes, and not laid over one mesh of all devices: each process
trains its batches on its own devices, as if it were alone. No collective waits for another machine, machines may differ, and
one that fails takes nothing with it. `jax.distributed` finds the cluster's settings and brings the processes together once, in
a child process; after that they only share the folder, and every process is a plain JAX program.
"""

from __future__ import annotations

import argparse
import contextvars
import json
import os
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any, NamedTuple

from peps_jax.storage import files
from peps_jax.sweep.journal import FOLDER

BEAT = 5.0  # s between two signs of life
SILENCE = 60.0  # s without one after which a process is taken for dead
LATE = 30.0  # s by which a shared folder may show a file later than another one
PATIENCE = 300  # s for all processes to come together
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


def join(coordinator: str | None = None, count: int | None = None, index: int | None = None) -> Team:
    """Waits until all processes are there. What is None is found in the settings of Slurm or another cluster.

    Args:
      coordinator: host:port of process 0.
      count: of processes.
      index: of this one, from 0.

    Raises:
      ValueError: they don't come together; one line says why.
    """
    asked = json.dumps({"coordinator_address": coordinator, "num_processes": count, "process_id": index})
    # A child of its own, because a process that was once part of a distributed JAX counts the others' devices for ever.
    environment = os.environ | {"JAX_PLATFORMS": "cpu", "XLA_FLAGS": ""}
    child = subprocess.run(
        [sys.executable, "-m", "peps_jax.sweep.workers", asked], capture_output=True, encoding="utf-8", env=environment
    )
    last = child.stdout.strip().splitlines()[-1:]
    if child.returncode or not last:
        reason = (child.stderr.strip().splitlines() or ["no reason given"])[-1]
        raise ValueError(
            f"the processes didn't come together: {reason} (without a cluster that JAX knows, give every process "
            "--coordinator HOST:PORT, --processes and --process)"
        )
    team = Team(**json.loads(last[0]))
    if team.accelerators:
        import jax

        jax.config.update("jax_cuda_visible_devices", team.accelerators)
        jax.config.update("jax_rocm_visible_devices", team.accelerators)
    return team


def _meet(asked: dict[str, Any]) -> Team:
    """The child's part of `join`."""
    import socket
    import zlib

    import jax
    import numpy as np
    from jax.experimental import multihost_utils

    jax.distributed.initialize(**asked, initialization_timeout=PATIENCE)
    own = [zlib.crc32(socket.gethostname().encode()), *np.frombuffer(os.urandom(8), np.uint32)]
    all_ = np.asarray(multihost_utils.process_allgather(np.asarray(own, np.uint32))).reshape(-1, 3)
    accelerators = jax.config.read("jax_cuda_visible_devices")
    team = Team(
        index=jax.process_index(),
        count=jax.process_count(),
        run=all_[0, 1:].tobytes().hex(),
        neighbours=int(np.sum(all_[:, 0] == all_[jax.process_index(), 0])),
        accelerators="" if accelerators in (None, "all") else accelerators,
    )
    jax.distributed.shutdown()
    return team


class Life:
    """Tells the others, by a file in the sweep's folder, that this process is at work; and how it ended.

    It is silent once the folder is another sweep's.
    """

    def __init__(self, folder: Path, team: Team):
        self._path = _path(folder, team.index)
        self._team, self._beats = team, 0
        self._over = threading.Event()
        self._thread: threading.Thread | None = None
        self._told = {"status": RUNNING, "reason": ""}

    def begin(self) -> None:
        """From now on there is a sign of life every `BEAT` seconds."""
        if self._team.count > 1:
            self._tell()
            # in a copy of the context, for the thread writes as this one does: for the folder's owner
            beat = contextvars.copy_context().run
            self._thread = threading.Thread(target=beat, args=(self._beat,), daemon=True)
            self._thread.start()

    def end(self, status: str, reason: str = "") -> None:
        """How it ended: DONE, STOPPED or FAILED."""
        if self._thread is not None and not self._over.is_set():
            self._over.set()
            self._thread.join()
            self._told = {"status": status, "reason": reason}
            self._tell()

    def _beat(self) -> None:
        while not self._over.wait(BEAT):
            self._tell()

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
                print(f"no sign of life: {error}", file=sys.stderr)


class Others:
    """The other processes, as their signs of life tell."""

    def __init__(self, folder: Path, team: Team):
        self._folder, self._team = folder, team
        now = time.monotonic()
        self._seen = {index: (0, now) for index in range(team.count) if index != team.index}  # beat, and when it came

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

    def _told(self, index: int) -> dict[str, Any]:
        nothing = {"status": RUNNING, "beat": 0, "run": self._team.run, "reason": ""}
        try:
            told = json.loads(_path(self._folder, index).read_text(encoding="utf-8"))
        except (OSError, ValueError):
            return nothing
        return told if told["run"] == self._team.run else nothing  # an earlier run's


def _path(folder: Path, index: int) -> Path:
    return folder / FOLDER / f"process-{index:05d}.json"


if __name__ == "__main__":
    reader = argparse.ArgumentParser(description="The child's part of `join`: prints the team as JSON.")
    reader.add_argument("asked")
    print(json.dumps(_meet(json.loads(reader.parse_args().asked))._asdict()))
