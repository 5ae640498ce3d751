"""What a command of the study's command line is: its flags, and what it does."""

from __future__ import annotations

import argparse
import contextlib
import threading
from collections.abc import Callable
from typing import Any, NamedTuple

from peps_jax.command_line import Work

OUT = "results/study"


class Action(NamedTuple):
    """A command.

    `flags(parser)` adds its flags to those that all have (`--out`); `prepare(values)` makes its work, or raises ValueError in one
    line; `about` says in a few words what it does.
    """

    about: str
    flags: Callable[[argparse.ArgumentParser], Any]
    prepare: Callable[[argparse.Namespace], Work]
    computes: bool = False  # whether it needs JAX's devices, other than the CPU


class Errand:
    """Work that is one function, and keeps nothing that another run would go on with."""

    name, makes_checkpoints = "", False

    def __init__(self, do: Callable[[], int], kept: str = "nothing is lost", close: Callable[[], None] = lambda: None):
        self._do, self._kept, self._close = do, kept, close

    def run(self, stop: threading.Event) -> int:
        return self._do()

    def kept(self) -> str:
        return self._kept

    def writing(self) -> contextlib.AbstractContextManager[None]:
        return contextlib.nullcontext()

    def close(self) -> None:
        self._close()
