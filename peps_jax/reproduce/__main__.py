"""The command line.

    python -m peps_jax.reproduce table1 figure1 --out results/reproduce

A stopped command continues where it was. Bad input gets one line on stderr and exit code 2 before anything compiles; Ctrl-C
keeps the batches that are finished, with exit code 130.
"""

from __future__ import annotations

import argparse
import dataclasses
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

from peps_envs.registry import unknown_name
from peps_jax.command_line import Parser, options, print_whatever_can_be_shown, refuse, use_every_core
from peps_jax.config import Config
from peps_jax.execution import machine
from peps_jax.reproduce import figures, tables
from peps_jax.reproduce.driving import figure3
from peps_jax.reproduce.driving.experiment import STEPS
from peps_jax.reproduce.figures import QUERY_SEEDS
from peps_jax.reproduce.store import Store
from peps_jax.reproduce.trainings import DOMAINS, FEW_SEEDS, METHODS, Planned, Study, Training
from peps_jax.storage.files import NotWrittenError, OwnershipLostError

PROG = "python -m peps_jax.reproduce"
MOST = 1000  # seeds
DESCRIPTION = f"""\
The paper's evaluation: {", ".join(METHODS)} on {", ".join(DOMAINS)},
each with every seed, and the known-model planner beside them; and the driving study
(figure3). Trainings are kept in the folder: a stopped command continues where it was, and results share them."""


class Result(NamedTuple):
    """Something to reproduce."""

    text: str
    needs: Callable[[Study], list[Training | Planned]]
    write: Callable[[Study, Path], list[Path]]


RESULTS = {
    "table1": Result("return and explicability of every method", tables.table1_needs, tables.table1),
    "figure1": Result("the learned surrogate reward beside the true one", figures.figure1_needs, figures.figure1),
    "figure2": Result("rollouts of every method", figures.figure2_needs, figures.figure2),
    "figure3": Result("behaviours and ratings in the driving study", figure3.figure3_needs, figure3.figure3),
    "frontier": Result("return and explicability over lambda", figures.frontier_needs, figures.frontier),
    "queries": Result("explicability over the number of queries", figures.queries_needs, figures.queries),
    "ablations": Result("PEPS and DRLHP without parts of them", tables.ablations_needs, tables.ablations),
}
GROUPS = {"paper": ("table1", "figure1", "figure2"), "all": tuple(RESULTS)}


@dataclasses.dataclass(frozen=True)
class Request:
    """What a command line asks for, checked."""

    names: tuple[str, ...]  # of results
    study: Study
    store: Store


def parser() -> Parser:
    """The command line's parser."""
    texts = "\n".join(f"  {name:10} {result.text}" for name, result in RESULTS.items())
    groups = "\n".join(f"  {name:10} {', '.join(members)}" for name, members in GROUPS.items())
    epilog = f"results:\n{texts}\n{groups}\n\nfrontier and ablations take the first {FEW_SEEDS} seeds, queries {QUERY_SEEDS}."
    made = Parser(
        prog=PROG, usage=f"{PROG} [RESULT ...] [flags]", description=DESCRIPTION, epilog=epilog, allow_abbrev=False,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )  # fmt: skip
    made.add_argument("results", nargs="*", default=["paper"], metavar="RESULT", help="what to reproduce [paper]")
    made.add_argument("--out", default="results/reproduce", metavar="DIR", help="folder [results/reproduce]")
    made.add_argument("--seeds", default=10, help="trainings of each method in each domain [10]", **options(10))
    steps = Config().total_steps
    text = f"environment steps of a training [{steps}, and {STEPS} of the driving study's]"
    made.add_argument("--steps", default=None, help=text, **options(steps))
    return made


def request(arguments: Sequence[str], base: Config, num_episodes: int) -> Request:
    """Reads and checks a command line.

    Raises:
      ValueError: a value makes no sense, or the folder holds something else.
      SystemExit: a flag that doesn't exist or can't be read (code 2), or --help (code 0).
    """
    values = parser().parse(arguments)
    machine.meet_devices()
    for name in values.results:
        if name not in (*RESULTS, *GROUPS):
            raise ValueError(unknown_name("result", name, (*RESULTS, *GROUPS)))
    if not 2 <= values.seeds <= MOST:
        raise ValueError(f"seeds {values.seeds} is out of range: choose 2 to {MOST} (an interval needs two)")
    base = base if values.steps is None else base.replace(total_steps=values.steps)
    base.check()
    names = tuple(dict.fromkeys(each for name in values.results for each in GROUPS.get(name, (name,))))
    made = Request(
        names, Study(base, values.seeds, num_episodes), Store(Path(values.out), base, num_episodes, values.seeds)
    )
    wanted = [what for name in names for what in RESULTS[name].needs(made.study)]
    missing = made.study.missing(wanted, made.store)
    made.study.batches([what for what in missing if isinstance(what, Training)][:1])  # to see, early, that one fits
    if "figure3" in names:
        figure3.check(made.study, made.store.folder)
    made.store.open()
    return made


def run(wanted: Request) -> list[Path]:
    """Makes what is missing for each result, and writes it; returns the files."""
    written = []
    for name in wanted.names:
        needs = RESULTS[name].needs(wanted.study)
        missing = wanted.study.missing(needs, wanted.store)
        number = len({what.name for what in needs})
        there = f"{number - len(missing)} of {number} trainings and plans are there" if number else "the driving study"
        print(f"{name}: {there}", file=sys.stderr, flush=True)
        wanted.study.make(missing, wanted.store)
        written += RESULTS[name].write(wanted.study, wanted.store.folder)
    return written


def main(arguments: Sequence[str] | None = None, base: Config | None = None, num_episodes: int = 100) -> int:
    """Runs the command line; returns the exit code.

    Args:
      arguments: of the command line; the process's own by default.
      base: settings of every training; the package's defaults by default.
      num_episodes: rollouts of each training.
    """
    print_whatever_can_be_shown()
    use_every_core()
    arguments = sys.argv[1:] if arguments is None else arguments
    try:
        wanted = request(arguments, Config() if base is None else base, num_episodes)
    except (ValueError, NotWrittenError) as error:
        return refuse(PROG, error)
    try:
        with wanted.store.writing():
            written = run(wanted)
    except OwnershipLostError as error:
        return refuse(PROG, error)
    except KeyboardInterrupt:
        print(
            f"\nstopped: what is finished is kept in {wanted.store.folder}; the same command continues", file=sys.stderr
        )
        return 130
    except NotWrittenError as error:
        return refuse(PROG, f"{error}; what is finished is kept, and the same command continues")
    finally:
        wanted.store.close()
    for path in written:
        if path.suffix == ".md":
            print(path.read_text(encoding="utf-8"))
    print(f"in {wanted.store.folder}: {', '.join(path.name for path in written)}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
