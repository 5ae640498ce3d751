"""What the command lines share: every core of a CPU as a device, flags made of settings, complaints of one line."""

from __future__ import annotations

import argparse
import codecs
import difflib
import io
import os
import sys
from collections.abc import Callable, Sequence
from typing import Any, NoReturn

REPLACED = "peps_jax.replaced"  # how what a terminal can't show is written
SUBSTITUTES = {"±": "+-", "–": "-", "—": "-", "λ": "lambda", "…": "..."}
FORCED_DEVICES = "--xla_force_host_platform_device_count"


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
    """Complains in one line."""

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
