"""The command line.

    python -m peps_jax.reproduce.driving --seeds 10 --out results/study

Bad input gets one line on stderr and exit code 2 before anything compiles; Ctrl-C ends with exit code 130,
SIGTERM with 143.
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import sys
import threading
from collections.abc import Sequence
from pathlib import Path

from peps_jax.command_line import Command, Parser, options
from peps_jax.reproduce.driving import experiment, report
from peps_jax.storage.files import check_writable
from peps_jax.storage.ownership import Owner

PROG = "python -m peps_jax.reproduce.driving"
MOST = 1000  # seeds
FILES = (report.TABLE, report.PICTURE, report.FILM, report.NUMBERS)
DESCRIPTION = """\
The paper's driving study (Sec. 5.2), simulated: participants compare scenes on a dry
road, agents learn from that and drive in the rain, other participants rate them."""


@dataclasses.dataclass(frozen=True)
class Request:
    """What a command line asks for, checked."""

    parts: list[experiment.Part]
    out: Path
    overwrite: bool

    def check_free(self) -> None:
        """Raises ValueError if the folder holds a study that nobody asked to replace."""
        there = [name for name in FILES if (self.out / name).exists()]
        if there and not self.overwrite:
            raise ValueError(
                f"out {str(self.out)!r} holds another study ({there[0]}): choose another folder, "
                "or add --overwrite to replace it"
            )


def parser() -> Parser:
    """The command line's parser."""
    made = Parser(PROG, description=DESCRIPTION)
    steps, lams = experiment.STEPS, experiment.LAMS
    made.add_argument("--out", default="results/study", metavar="DIR", help="folder to write [results/study]")
    made.add_argument("--overwrite", action="store_true", help="replace the study that the folder holds")
    text = "agents of each method, each with trainers of its own [10]"
    made.add_argument("--seeds", default=10, help=text, **options(10))
    made.add_argument("--seed", default=0, help="the first of them [0]", **options(0))
    text = f"environment steps of a training [{steps}]"
    made.add_argument("--steps", default=steps, help=text, **options(steps))
    text = (
        f"lambdas that PEPS is shown at, beside the study's {experiment.SETTINGS['lam']:g} [{' '.join(map(str, lams))}]"
    )
    made.add_argument("--lams", nargs="*", default=lams, help=text, **options(2.0))
    return made


def request(values: argparse.Namespace) -> Request:
    """What a command line asks for. Raises ValueError for a value that makes no sense, or if the folder holds another study."""
    if not 1 <= values.seeds <= MOST:
        raise ValueError(f"seeds {values.seeds} is out of range: choose 1 to {MOST}")
    last = 2**31 - values.seeds
    if not 0 <= values.seed <= last:
        raise ValueError(f"seed {values.seed} is out of range: choose 0 to {last}")
    for lam in values.lams:
        if not 0 <= lam < float("inf"):
            raise ValueError(f"lams {lam:g} is out of range: choose 0 or more")
    parts = experiment.parts(range(values.seed, values.seed + values.seeds), values.steps, dict.fromkeys(values.lams))
    for part in parts:
        part.configs[0].check()
    wanted = Request(parts, Path(values.out), values.overwrite)
    check_writable(wanted.out)
    wanted.check_free()
    return wanted


class DrivingStudy:
    """The study, run and written all at once."""

    name, makes_checkpoints = "", False

    def __init__(self, wanted: Request):
        self._wanted = wanted
        self._owner = Owner(wanted.out)

    def begin(self) -> None:
        """Takes the folder. Raises ValueError if it is another's or holds another study."""
        self._owner.claim(self._wanted.check_free, over=self._wanted.overwrite)

    def run(self, stop: threading.Event) -> int:
        out = self._wanted.out
        written = report.write(experiment.run(self._wanted.parts), out)
        print((out / report.TABLE).read_text(encoding="utf-8"))
        print(f"in {out}: {', '.join(path.name for path in written)}")
        return 0

    def kept(self) -> str:
        return "nothing is written"

    def writing(self) -> contextlib.AbstractContextManager[None]:
        return self._owner.writing()

    def close(self) -> None:
        self._owner.release()


def prepare(values: argparse.Namespace) -> DrivingStudy:
    """The study that a command line asks for, with its folder."""
    study = DrivingStudy(request(values))
    study.begin()
    return study


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command line; returns the exit code."""
    return Command(PROG, lambda given: parser().parse(given), prepare).carry_out(arguments)


if __name__ == "__main__":
    sys.exit(main())
