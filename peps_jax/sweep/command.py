"""The command line: trains every cell of a grid of worlds, methods, lambdas and seeds, and writes a results folder.

    python -m peps_jax.sweep --env nav-d1 nav-d4 --method peps sac --lam 2.0 2.4 2.8 --seeds 8 --out results/mine
    python -m peps_jax.sweep --resume --out results/mine

Cells that share a structure run as one program over all devices; see `peps_jax.execution.batches`, and
`peps_jax.sweep.results` for what the folder holds. Every field of `Config` is a flag.
Bad input gets one line on stderr and exit code 2 before anything compiles.
Ctrl-C keeps the batches that are finished, with exit code 130; SIGTERM also makes a checkpoint of the one under way, with
exit code 143. After either, or a kill, `--resume` continues, and gets the numbers of a sweep that was never stopped.
A folder is one sweep's at a time: one from which `--resume` or `--overwrite` took it writes nothing more, says so in one line
and ends with exit code 2. A sweep all of whose cells failed ends with exit code 1.
"""

from __future__ import annotations

import contextlib
import os
import shlex
import signal
import sys
import threading
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from peps_jax.command_line import print_whatever_can_be_shown, refuse, use_every_core
from peps_jax.execution import checkpoints, machine
from peps_jax.execution.waiting import Reminder
from peps_jax.storage import files, ownership
from peps_jax.sweep import journal, meeting, results, workers
from peps_jax.sweep.arguments import PROG, Request, flags, read
from peps_jax.sweep.results import Row
from peps_jax.sweep.summary import print_table
from peps_jax.sweep.underway import StoppedError, Sweep


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
    print_whatever_can_be_shown()
    use_every_core()
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    try:
        asked = flags(arguments)
        place = _place(asked.running)  # first, for a cluster may give each process devices of its own
        machine.meet_devices()
        wanted = read(asked)
        if wanted.resume and results.is_complete(wanted.out):
            return _nothing_to_continue(wanted)
        team = workers.alone() if place is None else meeting.join(place, wanted.running["wait"])
        sweep = Sweep(wanted, wanted.begun_by or _as_text(shlex.join([*PROG.split(), *arguments])), team)
        sweep.begin()
    except (ValueError, files.NotWrittenError) as error:
        return refuse(PROG, error)
    except KeyboardInterrupt:
        print("\nstopped before anything was trained", file=sys.stderr)
        return 130
    try:
        with sweep.owner.writing():
            return _run(sweep, wanted, team)
    except ownership.OwnershipLostError as error:
        return refuse(PROG, error)


def _place(running: Mapping[str, Any]) -> meeting.Place | None:
    """Where this process joins the others; None of a sweep in one process."""
    if not (running["distributed"] or running["coordinator"]):
        return None
    place = meeting.find(*(running[name] for name in ("coordinator", "processes", "process")))
    meeting.use_own_accelerators(place)
    return place


def _as_text(command: str) -> str:
    """A command as UTF-8 has it: a locale that knows ASCII alone took its words for bytes."""
    return os.fsencode(command).decode("utf-8", "surrogateescape")


def _run(sweep: Sweep, wanted: Request, team: workers.Team) -> int:
    """Trains this process's share; the process that leads makes the tables of all. Returns the exit code."""
    life = workers.Life(wanted.out, team)
    life.begin()
    with terminable() as stop:
        try:
            sweep.run(stop)
            if not team.leads:
                end = life.others.ends().get(0)
                life.end(workers.DONE)
                return _share_done(wanted, team, end)
            wrong = sweep.gather(stop, life.others)
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
        except ownership.OwnershipLostError as error:
            life.end(workers.FAILED, str(error))
            raise
        except (files.NotWrittenError, checkpoints.IncompatibleError) as error:
            life.end(workers.FAILED, str(error))
            return refuse(PROG, f"{error}; {_kept(sweep, wanted)}")
        except Exception as error:
            life.end(workers.FAILED, f"{type(error).__name__}: {error}".splitlines()[0])
            print(f"failed: {_kept(sweep, wanted)}", file=sys.stderr)
            raise
    return _tell(rows, wanted, pictures)


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
    failed = sum(row.finished.failed for row in rows)
    if failed:
        print(f"{failed} of {len(rows)} cells failed: something learned or evaluated is not finite")
    print(
        f"in {wanted.out}: {results.TABLE}, {results.CURVES}, {results.MANIFEST}, {results.CELLS}/, {', '.join(pictures)}"
    )
    if failed == len(rows):
        return 1
    print(f"go on with: peps_jax.load({str(wanted.out)!r}, {wanted.cells[0].name!r})")
    return 0


def _nothing_to_continue(wanted: Request) -> int:
    """Says that the sweep is complete, and clears up if it was killed just then; returns the exit code."""
    if journal.is_open(wanted.out):
        _clear_up(wanted.out)
    failed = results.all_failed(wanted.out)
    print(
        f"{wanted.out} is complete: {len(wanted.cells)} cells, nothing to continue"
        + ", and all of them failed" * failed
    )
    return 1 if failed else 0


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


def _kept(sweep: Sweep, wanted: Request) -> str:
    """Writes the tables of what is finished, and tells how to go on. Raises OwnershipLostError."""
    sweep.owner.check()
    try:
        sweep.save("interrupted")
    except ownership.OwnershipLostError:
        raise
    except files.NotWrittenError:  # the cells' own files are there, and make them again
        pass
    done = len(sweep.rows())  # of a process that doesn't lead: its own
    kept = f"{done} of {len(wanted.cells)} cells are finished" + f" and kept in {wanted.out}" * (done > 0)
    return f"{kept}; continue with: {wanted.continued}"


def _incomplete(sweep: Sweep, wanted: Request, wrong: Mapping[int, str]) -> int:
    kept = _kept(sweep, wanted)
    for index, reason in wrong.items():
        print(f"process {index} didn't finish: {reason}", file=sys.stderr)
    print(f"incomplete: {kept}", file=sys.stderr)
    return 1


def _draw(rows: Sequence[Row], folder: Path) -> list[str]:
    from peps_jax.sweep import pictures  # matplotlib takes its time

    print("drawing", file=sys.stderr)
    with Reminder("drawing"):
        return [path.name for path in pictures.draw(rows, folder)]


if __name__ == "__main__":
    sys.exit(main())
