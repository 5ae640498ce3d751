"""The command line.

    python -m peps_jax.reproduce table1 figure1 --out results/reproduce

A stopped command continues where it was. Bad input gets one line on stderr and exit code 2 before anything compiles; Ctrl-C
keeps the batches that are finished, with exit code 130, and so does SIGTERM, with exit code 143.
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import sys
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import Protocol

from peps_envs.registry import unknown_name
from peps_jax.command_line import Command, Parser, called, options
from peps_jax.config import Config
from peps_jax.execution.waiting import Reminder
from peps_jax.reproduce import (
    ablations,
    answers,
    baselines,
    bias,
    figure1,
    figure2,
    figure3,
    frontier,
    physics,
    queries,
    table1,
    table1_many,
    teachers,
)
from peps_jax.reproduce.driving.experiment import STEPS
from peps_jax.reproduce.plan import DOMAINS, FEW_SEEDS, METHODS, Need, Plan, Training
from peps_jax.reproduce.queries import QUERY_SEEDS
from peps_jax.reproduce.store import Store

PROG = called("peps_jax.reproduce", "peps-reproduce")
MOST = 1000  # seeds
DESCRIPTION = f"""\
The paper's evaluation: {", ".join(METHODS)} on {", ".join(DOMAINS)},
each with every seed, and the known-model planner beside them; and the driving study
(figure3). Trainings are kept in the folder: a stopped command continues where it was, and results share them."""


class Result(Protocol):
    """Something to reproduce: a module of its own."""

    ABOUT: str

    def needs(self, plan: Plan) -> list[Need]:
        """What has to be there before it is written."""

    def write(self, plan: Plan, folder: Path) -> list[Path]:
        """Writes its files from the records of what it needs; returns their paths."""


RESULTS: dict[str, Result] = {
    "table1": table1,
    "figure1": figure1,
    "figure2": figure2,
    "figure3": figure3,
    "table1_many": table1_many,
    "baselines": baselines,
    "answers": answers,
    "frontier": frontier,
    "teachers": teachers,
    "bias": bias,
    "queries": queries,
    "ablations": ablations,
    "physics": physics,
}
GROUPS = {"paper": ("table1", "figure1", "figure2"), "all": tuple(RESULTS)}


@dataclasses.dataclass(frozen=True)
class Request:
    """What a command line asks for, checked."""

    names: tuple[str, ...]  # of results
    plan: Plan
    store: Store


def parser() -> Parser:
    """The command line's parser."""
    texts = "\n".join(f"  {name:11} {result.ABOUT}" for name, result in RESULTS.items())
    groups = "\n".join(f"  {name:11} {', '.join(members)}" for name, members in GROUPS.items())
    fewer = (
        f"frontier, teachers, bias and ablations take the first {FEW_SEEDS} seeds, queries {QUERY_SEEDS}, "
        f"answers {answers.SEEDS}."
    )
    epilog = f"results:\n{texts}\n{groups}\n\n{fewer}"
    made = Parser(PROG, "[RESULT ...] ", description=DESCRIPTION, epilog=epilog)
    made.add_argument("results", nargs="*", default=["paper"], metavar="RESULT", help="what to reproduce [paper]")
    made.add_argument("--out", default="results/reproduce", metavar="DIR", help="folder [results/reproduce]")
    made.add_argument("--seeds", default=10, help="trainings of each method in each domain [10]", **options(10))
    steps = Config().total_steps
    text = f"environment steps of a training [{steps}, and {STEPS} of the driving study's]"
    made.add_argument("--steps", default=None, help=text, **options(steps))
    return made


def request(values: argparse.Namespace, base: Config, num_episodes: int) -> Request:
    """What a command line asks for, and its folder.

    Raises:
      ValueError: a value makes no sense, or the folder holds something else.
    """
    for name in values.results:
        if name not in (*RESULTS, *GROUPS):
            raise ValueError(unknown_name("result", name, (*RESULTS, *GROUPS)))
    if not 2 <= values.seeds <= MOST:
        raise ValueError(f"seeds {values.seeds} is out of range: choose 2 to {MOST} (an interval needs two)")
    base = base if values.steps is None else base.replace(total_steps=values.steps)
    base.check()
    names = tuple(dict.fromkeys(each for name in values.results for each in GROUPS.get(name, (name,))))
    made = Request(
        names, Plan(base, values.seeds, num_episodes), Store(Path(values.out), base, num_episodes, values.seeds)
    )
    wanted = [what for name in names for what in RESULTS[name].needs(made.plan)]
    missing = made.plan.missing(wanted, made.store)
    made.plan.batches([what for what in missing if isinstance(what, Training)][:1])  # to see, early, that one fits
    made.store.open()
    return made


class Reproduction:
    """The results that were asked for, made and written; a stopped one goes on with what is kept."""

    name, makes_checkpoints = "", False

    def __init__(self, wanted: Request):
        self._wanted = wanted

    def run(self, stop: threading.Event) -> int:
        """Makes what is missing for each result, writes it, and shows the tables."""
        wanted, written = self._wanted, []
        for name in wanted.names:
            needs = RESULTS[name].needs(wanted.plan)
            missing = wanted.plan.missing(needs, wanted.store)
            number = len({what.name for what in needs})
            print(f"{name}: {number - len(missing)} of {number} parts are there", file=sys.stderr, flush=True)
            wanted.plan.make(missing, wanted.store)
            with Reminder(f"{name}: computing and drawing"):
                written += RESULTS[name].write(wanted.plan, wanted.store.folder)
        for path in written:
            if path.suffix == ".md":
                print(path.read_text(encoding="utf-8"))
        print(f"in {wanted.store.folder}: {', '.join(path.name for path in written)}")
        return 0

    def kept(self) -> str:
        return f"what is finished is kept in {self._wanted.store.folder}; the same command continues"

    def writing(self) -> contextlib.AbstractContextManager[None]:
        return self._wanted.store.writing()

    def close(self) -> None:
        self._wanted.store.close()


def main(arguments: Sequence[str] | None = None, base: Config | None = None, num_episodes: int = 100) -> int:
    """Runs the command line; returns the exit code.

    Args:
      arguments: of the command line; the process's own by default.
      base: settings of every training; the package's defaults by default.
      num_episodes: rollouts of each training.
    """
    prepare = lambda values: Reproduction(request(values, Config() if base is None else base, num_episodes))
    return Command(PROG, lambda given: parser().parse(given), prepare).carry_out(arguments)


if __name__ == "__main__":
    sys.exit(main())
