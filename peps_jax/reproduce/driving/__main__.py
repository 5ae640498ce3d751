"""The command line.

    python -m peps_jax.reproduce.driving --seeds 10 --out results/study

Bad input gets one line on stderr and exit code 2 before anything compiles; Ctrl-C ends with exit code 130.
"""

from __future__ import annotations

import argparse
import dataclasses
import sys
from collections.abc import Sequence
from pathlib import Path

from peps_jax.command_line import Parser, options, print_whatever_can_be_shown, refuse, use_every_core
from peps_jax.execution import machine
from peps_jax.reproduce.driving import experiment, report
from peps_jax.storage.files import NotWrittenError, check_writable
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
    made = Parser(
        prog=PROG, usage=f"{PROG} [flags]", description=DESCRIPTION, allow_abbrev=False,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )  # fmt: skip
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


def request(arguments: Sequence[str]) -> Request:
    """Reads and checks a command line.

    Raises:
      ValueError: a value makes no sense, or the folder holds another study.
      SystemExit: a flag that doesn't exist or can't be read (code 2), or --help (code 0).
    """
    values = parser().parse(arguments)
    machine.meet_devices()
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


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command line; returns the exit code."""
    print_whatever_can_be_shown()
    use_every_core()
    try:
        wanted = request(sys.argv[1:] if arguments is None else arguments)
        owner = Owner(wanted.out)
        owner.claim(wanted.check_free, over=wanted.overwrite)
    except (ValueError, NotWrittenError) as error:
        return refuse(PROG, error)
    try:
        with owner.writing():
            written = report.write(experiment.run(wanted.parts), wanted.out)
    except KeyboardInterrupt:
        print("\nstopped: nothing is written", file=sys.stderr)
        return 130
    except NotWrittenError as error:
        return refuse(PROG, error)
    finally:
        owner.release()
    print((wanted.out / report.TABLE).read_text(encoding="utf-8"))
    print(f"in {wanted.out}: {', '.join(path.name for path in written)}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
