"""The command line: trains every cell of a grid of worlds, methods, lambdas and seeds, and writes a results folder.

    python -m peps_jax.sweep --env nav-d1 nav-d4 --method peps sac --lam 2.0 2.4 2.8 --seeds 8 --out results/mine
    python -m peps_jax.sweep --resume --out results/mine

Cells that share a structure run as one program over all devices; see `peps_jax.execution.batches`, and
`peps_jax.sweep.results` for what the folder holds. Every field of `Config` is a flag.
Bad input gets one line on stderr and exit code 2 before anything compiles.
Ctrl-C keeps the batches that are finished, with exit code 130; SIGTERM also makes a checkpoint of the one under way, with
exit code 143. After either, or a kill, `--resume` continues, and gets the numbers of a sweep that was never stopped.
"""

from __future__ import annotations

import contextlib
import json
import shlex
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path

import jax
import numpy as np

from peps_jax.command_line import refuse, use_every_core
from peps_jax.execution import batches, checkpoints, machine, memory
from peps_jax.execution.progress import Display, env_steps
from peps_jax.storage import files
from peps_jax.sweep import journal, results, workers
from peps_jax.sweep.arguments import PROG, Request, read
from peps_jax.sweep.results import Row
from peps_jax.sweep.summary import print_table


class StoppedError(Exception):
    """The process was asked to end, and has made a checkpoint."""


class Sweep:
    """A request on its way: what is finished, and its folder.

    Raises:
      ValueError: it doesn't fit in memory, or the folder doesn't hold what is to be continued.
      NotWrittenError: from whatever writes, if there is no room or no permission.
    """

    def __init__(self, wanted: Request, command: str, team: workers.Team):
        self._wanted, self._team = wanted, team
        self._configs = list(wanted.trainings.values())
        self._places = {name: place for place, name in enumerate(wanted.trainings)}
        self._writer = results.Writer(wanted.out, command, wanted.settings)
        self._ledger = journal.Ledger(wanted.out, _about(wanted))
        self._finished: dict[str, batches.Finished] = {}
        self._times, self._env_steps = batches.Times(), 0
        self._tables = checkpoints.Rhythm(1.0)
        self._plan = self._open() if team.leads else self._opened()
        self.batches = {number: self._batch(self._plan.batches[number]) for number in self._plan.shares[team.index]}

    # who does what

    def _open(self) -> journal.Plan:
        """Plans the sweep, or reads the plan of the one to be continued, and shares out what is left."""
        if self._wanted.resume:
            plan = self._ledger.plan()
            left = [number for number in range(len(plan.batches)) if not self._read(number, plan.batches[number])]
        else:
            names = list(self._wanted.trainings)
            batches = self._divided()
            left = list(range(len(batches)))
            plan = journal.Plan(
                tuple(journal.Planned(tuple(names[i] for i in one.cells), one.slots) for one in batches), (), ""
            )
            journal.clear(self._wanted.out)
        shares = tuple(tuple(left[index :: self._team.count]) for index in range(self._team.count))
        plan = plan._replace(shares=shares, run=self._team.run)
        self._ledger.begin(plan)
        self.save("running")
        return plan

    def _divided(self) -> list[batches.Batch]:
        devices = jax.devices()
        free = None  # measured
        if self._team.neighbours > 1 and not batches.side_by_side(devices):
            free = memory.available_bytes(devices) // self._team.neighbours
        most = batches.cells_soon_done(devices)
        return batches.plan(self._configs, self._wanted.episodes, devices, free, most, self._team.count)

    def _opened(self) -> journal.Plan:
        """Waits for process 0 to share out the batches."""
        end = time.monotonic() + workers.PATIENCE
        while time.monotonic() < end:
            with contextlib.suppress(ValueError):
                plan = self._ledger.plan()
                if plan.run == self._team.run:
                    return plan
            time.sleep(0.1)
        raise ValueError(
            f"out {str(self._wanted.out)!r}: process 0 hasn't shared out the batches in {workers.PATIENCE} s; "
            "see what it says, and that every process sees this folder"
        )

    def _batch(self, planned: journal.Planned) -> batches.Batch:
        devices = tuple(jax.devices()[: planned.slots])
        slots = planned.slots
        if slots % len(devices):  # it was planned for another machine
            slots = -(-len(planned.trainings) // len(devices)) * len(devices)
        return batches.Batch(tuple(self._places[name] for name in planned.trainings), slots, devices)

    # what is finished

    def rows(self) -> list[Row]:
        """The finished cells, in the grid's order."""
        finished = self._finished
        return [Row(cell, finished[cell.training]) for cell in self._wanted.cells if cell.training in finished]

    @property
    def complete(self) -> bool:
        return len(self._finished) == len(self._configs)

    def save(self, status: str) -> None:
        """Writes tables of what is finished."""
        if self._team.leads:
            with self._tables.making():
                self._writer.save(self.rows(), self._times, self._env_steps, status)

    def keep(self, number: int, finished: Sequence[batches.Finished], times: batches.Times) -> None:
        """Writes a batch that this process has finished."""
        cells = dict(zip(self._plan.batches[number].trainings, finished, strict=True))
        self._ledger.commit(number, cells, times)
        self._take(cells, times)

    def _take(self, cells: Mapping[str, batches.Finished], times: batches.Times) -> None:
        self._finished |= cells
        self._times += times
        self._env_steps += sum(env_steps(cell.result.config) for cell in cells.values())
        if self._tables.due():
            self.save("running")

    def _read(self, number: int, planned: journal.Planned) -> bool:
        """Takes in a batch that is done; whether it is. One that is damaged isn't."""
        try:
            done = self._ledger.done(number)
            if done is None:
                return False
            read = lambda name: results.read_cell(
                self._wanted.out, name, self._wanted.trainings[name], self._wanted.episodes, done.cells[name]
            )
            cells = {name: read(name) for name in planned.trainings}
        except files.DamagedError as error:
            print(f"a file of batch {number} is damaged ({error}): it is trained again", file=sys.stderr)
            return False
        self._take(cells, done.times)
        return True

    # what runs

    def run(self, stop: threading.Event) -> None:
        """Runs this process's batches, and takes in the others'.

        Raises:
          StoppedError: `stop` was set, and a checkpoint is made.
          IncompatibleError: a checkpoint that doesn't fit.
        """
        checkpoints.prepare()
        with Keeper(self, stop) as keeper:
            batches.run(self._configs, list(self.batches.values()), self._wanted.episodes, keeper)

    def gather(self, stop: threading.Event) -> dict[int, str]:
        """Takes in what the other processes finish, until all have ended; what went wrong, by process."""
        if self._team.count == 1 or not self._team.leads:
            return {}
        others = workers.Others(self._wanted.out, self._team)
        left = {number for share in self._plan.shares[1:] for number in share}
        patience = None
        while True:
            if stop.is_set():
                raise StoppedError
            ends = others.ends()
            left -= {number for number in left if self._read(number, self._plan.batches[number])}
            if not left or len(ends) == self._team.count - 1:
                # a shared folder may show the file of a batch later than the sign that its process is done
                patience = time.monotonic() + workers.LATE if patience is None else patience
                late = [
                    number for index, end in ends.items() if end == workers.DONE for number in self._plan.shares[index]
                ]
                if not left.intersection(late) or time.monotonic() > patience:
                    return {index: end for index, end in ends.items() if end != workers.DONE}
            time.sleep(0.2)

    def checkpoints(self, number: int) -> checkpoints.Checkpoints:
        return self._ledger.checkpoints(number, [self._configs[place] for place in self.batches[number].cells])

    def close(self) -> None:
        """Tables are written and pictures drawn: nothing is left to continue."""
        self.save("complete")
        journal.close(self._wanted.out)


class Keeper(Display):
    """Progress on stderr; checkpoints, and every batch kept as soon as it is done."""

    def __init__(self, sweep: Sweep, stop: threading.Event):
        super().__init__(sweep._configs, list(sweep.batches.values()), name=sweep._team.name)
        self._sweep, self._stop = sweep, stop
        self._number_of = {one: number for number, one in sweep.batches.items()}
        self._rhythm = checkpoints.Rhythm(sweep._wanted.running["checkpoint_every"])

    def start(self, current: batches.Batch) -> batches.Progress | None:
        if self._stop.is_set():
            raise StoppedError
        self._checkpoints = self._sweep.checkpoints(self._number_of[current])
        first = self._configs[current.cells[0]]
        progress = self._checkpoints.latest(batches.empty_progress(first, len(current.cells)))
        self.begin(current, progress.rounds if progress else 0)
        return progress

    def advanced(
        self,
        current: batches.Batch,
        rounds: int,
        curves: dict[str, np.ndarray],
        snapshot: Callable[[], batches.Progress],
    ) -> None:
        super().advanced(current, rounds, curves, snapshot)
        if self._stop.is_set() or self._rhythm.due():
            with self._rhythm.making():
                self._checkpoints.save(snapshot())
        if self._stop.is_set():
            raise StoppedError

    def finished(self, current: batches.Batch, cells: Sequence[batches.Finished], times: batches.Times) -> None:
        self._sweep.keep(self._number_of[current], cells, times)


def _about(wanted: Request) -> dict[str, str]:
    """What has to be the same for a sweep to be continued."""
    told = machine.describe()
    versions = {name: told["versions"][name] for name in ("peps-jax", "jax", "jaxlib")}
    device = jax.devices()[0]
    numbers = journal.numbers_digest(list(wanted.trainings.values()))
    return versions | {
        "devices": f"{device.platform} {device.device_kind}",
        "configuration": files.json_digest([files.plain(wanted.settings), numbers]),
    }


@contextlib.contextmanager
def terminable() -> Iterator[threading.Event]:
    """SIGTERM sets the event meanwhile, and ends nothing by itself."""
    stop = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield stop
        return
    before = signal.signal(signal.SIGTERM, lambda *_: stop.set())
    try:
        yield stop
    finally:
        signal.signal(signal.SIGTERM, before)


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command line; returns the exit code."""
    use_every_core()
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    try:
        wanted = read(arguments)
        if wanted.resume and _is_complete(wanted.out):
            journal.close(wanted.out)  # a kill may have come between the last table and this
            print(f"{wanted.out} is complete: {len(wanted.cells)} cells, nothing to continue")
            return 0
        by_hand = (wanted.running[name] for name in ("coordinator", "processes", "process"))
        distributed = wanted.running["distributed"] or wanted.running["coordinator"]
        team = workers.join(*by_hand) if distributed else workers.alone()
        sweep = Sweep(wanted, wanted.begun_by or shlex.join([*PROG.split(), *arguments]), team)
    except (ValueError, files.NotWrittenError) as error:
        return refuse(PROG, error)
    except KeyboardInterrupt:
        print("\nstopped before anything was trained", file=sys.stderr)
        return 130
    life = workers.Life(wanted.out, team)
    with terminable() as stop:
        try:
            sweep.run(stop)
            if not team.leads:
                life.end(workers.DONE)
                print(f"{team.name}: its share is done; process 0 makes the tables", file=sys.stderr)
                return 0
            wrong = sweep.gather(stop)
            if not sweep.complete:
                return _incomplete(sweep, wanted, wrong)
            rows = sweep.rows()
            pictures = _draw(rows, wanted.out)
            life.end(workers.DONE)
            sweep.close()
        except (KeyboardInterrupt, StoppedError) as reason:
            life.end(workers.STOPPED, "asked to")
            who = f"{team.name} " if team.name else ""
            print(f"\n{who}stopped: {_kept(sweep, wanted)}", file=sys.stderr)
            return 130 if isinstance(reason, KeyboardInterrupt) else 143
        except (files.NotWrittenError, checkpoints.IncompatibleError) as error:
            life.end(workers.FAILED, str(error))
            return refuse(PROG, f"{error}; {_kept(sweep, wanted)}")
        except Exception as error:
            life.end(workers.FAILED, f"{type(error).__name__}: {error}".splitlines()[0])
            print(f"failed: {_kept(sweep, wanted)}", file=sys.stderr)
            raise
    print_table(rows)
    failed = sum(row.finished.failed for row in rows)
    if failed:
        print(f"{failed} of {len(rows)} cells failed: something learned or evaluated is not finite")
    print(
        f"in {wanted.out}: {results.TABLE}, {results.CURVES}, {results.MANIFEST}, {results.CELLS}/, {', '.join(pictures)}"
    )
    print(f"go on with: peps_jax.load({str(wanted.out)!r}, {wanted.cells[0].name!r})")
    return 0


def _is_complete(out: Path) -> bool:
    return json.loads((out / results.MANIFEST).read_text()).get("status") == "complete"


def _kept(sweep: Sweep, wanted: Request) -> str:
    """Writes the tables of what is finished, and tells how to go on."""
    with contextlib.suppress(files.NotWrittenError):  # the cells' own files are there, and make them again
        sweep.save("interrupted")
    done = len(sweep.rows())  # of a process that doesn't lead: its own
    kept = f"{done} of {len(wanted.cells)} cells are finished" + f" and kept in {wanted.out}" * (done > 0)
    return f"{kept}; continue with: {wanted.continued}"


def _incomplete(sweep: Sweep, wanted: Request, wrong: Mapping[int, str]) -> int:
    for index, reason in wrong.items():
        print(f"process {index} didn't finish: {reason}", file=sys.stderr)
    print(f"incomplete: {_kept(sweep, wanted)}", file=sys.stderr)
    return 1


def _draw(rows: Sequence[Row], folder: Path) -> list[str]:
    from peps_jax.sweep import pictures  # matplotlib takes its time

    print("drawing", file=sys.stderr)
    return [path.name for path in pictures.draw(rows, folder)]


if __name__ == "__main__":
    sys.exit(main())
