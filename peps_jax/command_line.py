"""What the command lines share: how they are called, begin and end, flags made of settings, complaints of one line.

    0    all is done
    1    part of the work failed: runs, or another process
    2    bad input, devices or processes that aren't there, a folder that can't be written or is another run's now
    130  Ctrl-C
    141  nobody reads what it prints any more, as after `| head`
    143  SIGTERM

Whatever ends a command but a fault in the code is one line on stderr.
"""

from __future__ import annotations

import argparse
import codecs
import contextlib
import difflib
import io
import os
import shutil
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, Generic, NoReturn, Protocol, TypeVar

from peps_jax.execution import machine
from peps_jax.execution.checkpoints import IncompatibleError
from peps_jax.storage.files import NotWrittenError, OwnershipLostError

REPLACED = "peps_jax.replaced"  # how what a terminal can't show is written
SUBSTITUTES = {"±": "+-", "–": "-", "—": "-", "λ": "lambda", "…": "..."}
FORCED_DEVICES = "--xla_force_host_platform_device_count"


Flags = TypeVar("Flags")


class StoppedError(Exception):
    """SIGTERM asked the process to end."""


class Work(Protocol):
    """What a command line asked for, ready to be done."""

    name: str  # of this process, where it is one of several
    makes_checkpoints: bool  # at SIGTERM `run` is told by its event and raises StoppedError; other work is interrupted

    def run(self, stop: threading.Event) -> int:
        """Does it; returns the exit code."""

    def kept(self) -> str:
        """Keeps what is finished, and tells it and how to go on."""

    def writing(self) -> contextlib.AbstractContextManager[None]:
        """What is written meanwhile is written for the folder's owner."""

    def close(self) -> None:
        """Gives back what isn't needed any more."""


class Command(Generic[Flags]):
    """A command line.

    Args:
      prog: how it was called; see `called`.
      read: reads the flags. Raises ValueError or, as argparse does, SystemExit.
      prepare: makes the work of them. Raises ValueError for what makes no sense, and NotWrittenError.
    """

    def __init__(self, prog: str, read: Callable[[Sequence[str]], Flags], prepare: Callable[[Flags], Work]):
        self._prog, self._read, self._prepare = prog, read, prepare

    def carry_out(self, arguments: Sequence[str] | None = None) -> int:
        """Does what the arguments, by default the process's own, ask for; returns the exit code."""
        try:
            try:
                return self._carry_out(arguments)
            finally:
                if sys.stdout is not None:
                    sys.stdout.flush()
        except BrokenPipeError:
            _print_no_more()
            return 141

    def _carry_out(self, arguments: Sequence[str] | None) -> int:
        print_whatever_can_be_shown()
        use_every_core()
        try:
            with terminable(at_once=True):
                flags = self._read(sys.argv[1:] if arguments is None else arguments)
                machine.meet_devices()  # whose settings `read` may have made
                work = self._prepare(flags)
        except (ValueError, NotWrittenError) as error:
            return refuse(self._prog, error)
        except (KeyboardInterrupt, StoppedError) as reason:
            return _stopped("stopped before anything was begun", reason)
        try:
            with work.writing():
                return self._run(work)
        except OwnershipLostError as error:
            return refuse(self._prog, error)
        finally:
            work.close()

    def _run(self, work: Work) -> int:
        try:
            with terminable(at_once=not work.makes_checkpoints) as stop:
                return work.run(stop)
        except OwnershipLostError:
            raise
        except (KeyboardInterrupt, StoppedError) as reason:
            return _stopped(f"{work.name} stopped: {work.kept()}".lstrip(), reason)
        except (NotWrittenError, IncompatibleError) as error:
            return refuse(self._prog, f"{error}; {work.kept()}")
        except BrokenPipeError:
            _print_no_more()
            work.kept()
            raise
        except Exception:
            print(f"failed: {work.kept()}", file=sys.stderr)
            raise


def _print_no_more() -> None:
    """What is printed from now on goes nowhere: Python would complain of a closed pipe once more as it ends."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(OSError, ValueError, AttributeError):
            os.dup2(nowhere, stream.fileno())
    os.close(nowhere)


def _stopped(text: str, reason: BaseException) -> int:
    print(f"\n{text}", file=sys.stderr)
    return 130 if isinstance(reason, KeyboardInterrupt) else 143


@contextlib.contextmanager
def terminable(at_once: bool) -> Iterator[threading.Event]:
    """SIGTERM sets the event meanwhile, and ends nothing by itself; or, `at_once`, raises StoppedError wherever the code is."""
    stop = threading.Event()

    def hear(*_: Any) -> None:
        stop.set()
        if at_once:
            raise StoppedError

    if threading.current_thread() is not threading.main_thread():
        yield stop
        return
    before = signal.signal(signal.SIGTERM, hear)
    try:
        yield stop
    finally:
        signal.signal(signal.SIGTERM, before)


def called(module: str, script: str) -> str:
    """How the user called a command: by its console script, or as `python -m module`."""
    return script if Path(sys.argv[0]).stem == script else f"python -m {module}"


def print_whatever_can_be_shown() -> None:
    """From now on stdout and stderr replace what their encoding doesn't have, where they would have raised an error."""
    codecs.register_error(REPLACED, _substitute)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # None where there is no such stream
            stream.reconfigure(errors=REPLACED)


def _substitute(error: UnicodeError) -> tuple[bytes, int]:
    """What is written in place of the characters that `error` is about, and where to go on."""
    if not isinstance(error, UnicodeEncodeError):
        raise error
    return b"".join(map(_shown_byte_by_byte, error.object[error.start : error.end])), error.end


def _shown_byte_by_byte(character: str) -> bytes:
    """A byte of a file's name as it is (Python keeps those that are no text as surrogates); what reads like the rest, or '?'."""
    if "\udc80" <= character <= "\udcff":
        return character.encode("utf-8", "surrogateescape")
    return SUBSTITUTES.get(character, "?").encode("ascii")


def refuse(prog: str, error: Exception | str) -> int:
    """Says in one line why a command does nothing, or no more; returns the exit code."""
    print(f"{prog}: error: {' '.join(str(error).split())}", file=sys.stderr)
    return 2


def use_every_core() -> None:
    """Asks JAX for one device per usable core of a CPU, unless the caller asked for a number. Before JAX meets its devices."""
    flags = os.environ.get("XLA_FLAGS", "")
    if FORCED_DEVICES not in flags:
        cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
        os.environ["XLA_FLAGS"] = f"{flags} {FORCED_DEVICES}={cores}".strip()


class Parser(argparse.ArgumentParser):
    """Complains in one line, and keeps the lines of its texts.

    Args:
      prog: as the user calls it.
      before: what its usage shows before the flags.
    """

    def __init__(self, prog: str, before: str = "", **more: Any):
        width = min(120, shutil.get_terminal_size((110, 24)).columns)
        lines = lambda prog: argparse.RawDescriptionHelpFormatter(prog, max_help_position=34, width=width)
        usage = f"{prog} {before}[flags]"
        super().__init__(prog=prog, usage=usage, formatter_class=lines, allow_abbrev=False, **more)

    def error(self, message: str) -> NoReturn:
        self.exit(2, f"{self.prog}: error: {' '.join(message.removeprefix('argument ').split())}\n")

    def parse(self, arguments: Sequence[str]) -> argparse.Namespace:
        """Like `parse_args`, but says which flag was meant."""
        values, unknown = self.parse_known_args(arguments)
        for argument in unknown:
            name = argument.split("=")[0]
            nearest = difflib.get_close_matches(name, self._option_string_actions, n=1)
            hint = f"did you mean {nearest[0]}? " if nearest and name.startswith("-") else ""
            self.error(f"flag {name!r} is unknown: {hint}--help lists them all")
        return values


def number(kind: type, example: Any) -> Callable[[str], Any]:
    """Reads an int or a float, and says what would be one."""

    def read(text: str) -> Any:
        try:
            return kind(text)
        except ValueError:
            right = "a whole number" if kind is int else "a number"
            raise argparse.ArgumentTypeError(f"{text!r} is not {right}, such as {example}") from None

    return read


def shown(value: Any) -> str:
    return " ".join(map(str, value)) if isinstance(value, tuple | list) else str(value)


def options(default: Any) -> dict[str, Any]:
    """How argparse reads a field whose default is `default`."""
    if isinstance(default, bool):
        return {"action": argparse.BooleanOptionalAction}
    if isinstance(default, int):
        return {"type": number(int, default), "metavar": "N"}
    if isinstance(default, float):
        return {"type": number(float, default), "metavar": "X"}
    if isinstance(default, tuple):
        return {"type": number(int, default[0]), "metavar": "N", "nargs": "+"}
    return {"metavar": "NAME"}
