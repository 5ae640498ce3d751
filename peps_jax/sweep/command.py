"""The command line: trains every combination of environments, methods, lambdas and seeds, and writes a results folder.

    python -m peps_jax.sweep --env nav-d1 nav-d4 --method peps sac --lam 2.0 2.4 2.8 --seeds 8 --out results/mine
    python -m peps_jax.sweep --resume --out results/mine

Runs that share a structure run as one program over all devices; see `peps_jax.execution.batches`, and
`peps_jax.sweep.results` for what the folder holds. Every field of `Config` is a flag.
Bad input gets one line on stderr and exit code 2 before anything compiles.
Ctrl-C keeps the batches that are finished, with exit code 130; SIGTERM also makes a checkpoint of the one under way, with
exit code 143. After either, or a kill, `--resume` continues, and gets the numbers of a sweep that was never stopped.
A folder is one sweep's at a time: one from which `--resume` or `--overwrite` took it writes nothing more, says so in one line
and ends with exit code 2. A sweep all of whose runs failed ends with exit code 1.
"""

from __future__ import annotations

import contextlib
import sys
import threading
from collections.abc import Mapping, Sequence
from pathlib import Path

from peps_jax.command_line import Command, Work
from peps_jax.execution.waiting import Reminder
from peps_jax.storage import files, ownership
from peps_jax.sweep import journal, meeting, results, workers
from peps_jax.sweep.arguments import PROG, Flags, Request, read, understood
from peps_jax.sweep.results import Row
from peps_jax.sweep.summary import print_table
from peps_jax.sweep.underway import Sweep


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command line; returns the exit code."""
    return Command(PROG, _read, _prepare).carry_out(arguments)


def _read(arguments: Sequence[str]) -> tuple[Flags, meeting.Place | None]:
    """The flags, and where this process joins the others if it is one of several: a cluster may give it devices of its own."""
    asked = read(arguments)
    if not (asked.running["distributed"] or asked.running["coordinator"]):
        return asked, None
    place = meeting.find(*(asked.running[name] for name in ("coordinator", "processes", "process")))
    meeting.use_own_accelerators(place)
    return asked, place


def _prepare(read: tuple[Flags, meeting.Place | None]) -> Work:
    """Makes sure that all of it makes sense, waits for the other processes, and takes the folder."""
    asked, place = read
    wanted = understood(asked)
    if wanted.resume and results.is_complete(wanted.out):
        return NothingToContinue(wanted)
    team = workers.alone() if place is None else meeting.join(place, wanted.running["wait"])
    sweep = Sweep(wanted, team)
    sweep.begin()
    return Training(wanted, team, sweep)


class Training:
    """A sweep, or this process's share of it: trained, gathered, and shown."""

    makes_checkpoints = True

    def __init__(self, wanted: Request, team: workers.Team, sweep: Sweep):
        self._wanted, self._team, self._sweep = wanted, team, sweep
        self.name = team.name

    def run(self, stop: threading.Event) -> int:
        """Trains this process's share; the process that leads makes the tables of all."""
        sweep = self._sweep
        with workers.Life(self._wanted.out, self._team) as life:
            sweep.run(stop, lambda rows: _drawn(rows, self._wanted.out))
            if not self._team.leads:
                return _share_done(self._wanted, self._team, life.others.ends().get(0))
            wrong = sweep.gather(stop, life.others)
            if not sweep.complete:
                return self._incomplete(wrong)
            rows = sweep.rows()
            pictures = _draw(rows, self._wanted.out)
        sweep.close()
        return _tell(rows, self._wanted, pictures)

    def kept(self) -> str:
        """Writes the tables of what is finished, and tells how to go on. Raises OwnershipLostError."""
        self._sweep.owner.check()
        try:
            self._sweep.save("interrupted")
        except ownership.OwnershipLostError:
            raise
        except files.NotWrittenError:  # the runs' own files are there, and make them again
            pass
        done = len(self._sweep.rows())  # of a process that doesn't lead: its own
        kept = f"{done} of {len(self._wanted.keys)} rows are finished" + f" and kept in {self._wanted.out}" * (done > 0)
        return f"{kept}; continue with: {self._wanted.continued}"

    def writing(self) -> contextlib.AbstractContextManager[None]:
        return self._sweep.owner.writing()

    def close(self) -> None:
        """Nothing: the folder of a sweep that isn't complete stays its own, until `--resume` takes it."""

    def _incomplete(self, wrong: Mapping[int, str]) -> int:
        kept = self.kept()
        for index, reason in wrong.items():
            print(f"process {index} didn't finish: {reason}", file=sys.stderr)
        print(f"incomplete: {kept}", file=sys.stderr)
        return 1


class NothingToContinue:
    """A sweep that is complete already."""

    name, makes_checkpoints = "", False

    def __init__(self, wanted: Request):
        self._wanted = wanted

    def run(self, stop: threading.Event) -> int:
        """Says so, and clears up if it was killed just then."""
        out = self._wanted.out
        if journal.is_open(out):
            _clear_up(out)
        failed = results.all_failed(out)
        rows = f"{len(self._wanted.keys)} rows"
        print(f"{out} is complete: {rows}, nothing to continue" + ", and all of them failed" * failed)
        return 1 if failed else 0

    def kept(self) -> str:
        return f"{self._wanted.out} is complete"

    def writing(self) -> contextlib.AbstractContextManager[None]:
        return contextlib.nullcontext()

    def close(self) -> None:
        """Nothing: it owns nothing."""


def _share_done(wanted: Request, team: workers.Team, end: str | None) -> int:
    """Says that a process that doesn't lead has done its part, while process 0 has come to that end; returns the exit code."""
    if end in (None, workers.DONE):
        print(f"{team.name}: its share is done; process 0 makes the tables", file=sys.stderr)
        return 0
    left = f"process 0, which makes the tables, doesn't go on ({end}); continue with: {wanted.continued}"
    print(f"{team.name}: its share is done and kept, but {left}", file=sys.stderr)
    return 1


def _tell(rows: Sequence[Row], wanted: Request, pictures: Sequence[str]) -> int:
    """Shows what a complete sweep found, and where; returns the exit code."""
    print_table(rows)
    failed = sum(row.run.failed for row in rows)
    if failed:
        print(f"{failed} of {len(rows)} rows failed: something learned or evaluated is not finite")
    print(
        f"in {wanted.out}: {results.TABLE}, {results.CURVES}, {results.MANIFEST}, {results.RUNS}/, {', '.join(pictures)}"
    )
    if failed == len(rows):
        return 1
    print(f"go on with: peps_jax.load({str(wanted.out)!r}, {wanted.keys[0].name!r})")
    return 0


def _clear_up(folder: Path) -> None:
    """Removes what a sweep that is complete has left, unless somebody else has the folder now."""

    def check() -> None:
        if not results.is_complete(folder):
            raise ValueError(f"out {str(folder)!r} was begun anew")

    owner = ownership.Owner(folder)
    with contextlib.suppress(ValueError, ownership.OwnershipLostError):
        owner.claim(check, over=True)
        with owner.writing():
            journal.close(folder)
        owner.release()


def _draw(rows: Sequence[Row], folder: Path) -> list[str]:
    print("drawing", file=sys.stderr)
    with Reminder("drawing"):
        return [path.name for path in _drawn(rows, folder)]


def _drawn(rows: Sequence[Row], folder: Path) -> list[Path]:
    from peps_jax.sweep import pictures  # matplotlib takes its time

    return pictures.draw(rows, folder)


if __name__ == "__main__":
    sys.exit(main())
