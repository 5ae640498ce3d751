"""The command line: trains every cell of a grid of worlds, methods, lambdas and seeds, and writes a results folder.

    python -m peps_jax.sweep --env nav-d1 nav-d4 --method peps sac --lam 2.0 2.4 2.8 --seeds 8 --out results/mine

Cells that share a structure run as one program over all devices; see `peps_jax.batch`, and `peps_jax.results` for what the
folder holds. Every field of `Config` is a flag. Bad input gets one line on stderr and exit code 2 before anything compiles.
Ctrl-C keeps the batches that are finished, with exit code 130.
"""

from __future__ import annotations

import argparse
import dataclasses
import difflib
import itertools
import os
import shlex
import shutil
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

import peps_envs
from peps_jax import batch, methods, results
from peps_jax.config import Config
from peps_jax.results import Cell, Row
from peps_jax.train import check

PROG = "python -m peps_jax.sweep"
FORCED_DEVICES = "--xla_force_host_platform_device_count"
MOST = 100_000  # seeds, and evaluation episodes
PATIENCE = 10.0  # s between two lines of progress where there is no terminal
GRID = ("env", "method", "lam")  # fields of which a sweep takes several values
DEMONSTRATION = {"env": ("nav-d1", "nav-d4"), "method": ("peps", "sac"), "lam": (2.4,)}

DESCRIPTION = """\
Trains every cell of a grid of worlds, methods, lambdas and seeds, side by side on all
devices, and writes tables, curves, learned parameters and pictures into a folder.
Without flags: a demonstration of a few minutes."""

EPILOG = """\
A method that doesn't use lambda (any but peps) is trained once for each world and seed; its row is
repeated for every lambda, so that the table holds the whole grid.

examples:
  python -m peps_jax.sweep
  python -m peps_jax.sweep --env nav-d1 nav-d4 --lam 2.0 2.4 2.8 --seeds 8 --out results/mine
  python -m peps_jax.sweep --env nav-d2 --belief unbiased --hidden-sizes 128 128 --out results/wide"""

TITLES = {
    "task": "task",
    "objective": "objective, Eq. (6)",
    "run": "size of a training",
    "sac": "soft actor-critic",
    "models": "learned dynamics and surrogate reward",
    "queries": "preferences",
    "human": "the synthetic human",
}


@dataclasses.dataclass(frozen=True)
class Request:
    """What a command line asks for, checked."""

    cells: list[Cell]  # the grid, in the order of the table
    trainings: dict[str, Config]  # by name; several cells may show one
    settings: dict[str, Any]  # every flag's value
    episodes: int  # of an evaluation
    out: Path


def use_every_core() -> None:
    """Asks JAX for one device per usable core of a CPU, unless the caller asked for a number. Before JAX meets its devices."""
    flags = os.environ.get("XLA_FLAGS", "")
    if FORCED_DEVICES not in flags:
        cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
        os.environ["XLA_FLAGS"] = f"{flags} {FORCED_DEVICES}={cores}".strip()


# --- what is asked for ----------------------------------------------------------------------------------------------------


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


def _number(kind: type, example: Any) -> Callable[[str], Any]:
    """Reads an int or a float, and says what would be one."""

    def read(text: str) -> Any:
        try:
            return kind(text)
        except ValueError:
            right = "a whole number" if kind is int else "a number"
            raise argparse.ArgumentTypeError(f"{text!r} is not {right}, such as {example}") from None

    return read


def _shown(value: Any) -> str:
    return " ".join(map(str, value)) if isinstance(value, tuple | list) else str(value)


def options(default: Any) -> dict[str, Any]:
    """How argparse reads a field whose default is `default`."""
    if isinstance(default, bool):
        return {"action": argparse.BooleanOptionalAction}
    if isinstance(default, int):
        return {"type": _number(int, default), "metavar": "N"}
    if isinstance(default, float):
        return {"type": _number(float, default), "metavar": "X"}
    if isinstance(default, tuple):
        return {"type": _number(int, default[0]), "metavar": "N", "nargs": "+"}
    return {"metavar": "NAME"}


def parser() -> Parser:
    """The command line's parser, made of `Config`'s fields."""
    width = min(120, shutil.get_terminal_size((110, 24)).columns)
    made = Parser(
        prog=PROG, usage=f"{PROG} [flags]", description=DESCRIPTION, epilog=EPILOG, add_help=False, allow_abbrev=False,
        formatter_class=lambda prog: argparse.RawDescriptionHelpFormatter(prog, max_help_position=34, width=width),
    )  # fmt: skip
    group = made.add_argument_group("grid")
    texts = {
        "env": f"worlds: {', '.join(peps_envs.names())}",
        "method": f"methods: {', '.join(methods.METHODS)}",
        "lam": "reconciliation parameters: weight of explicability against return",
    }
    for name in GRID:
        kind = {"type": _number(float, 2.4), "metavar": "X"} if name == "lam" else {"metavar": "NAME"}
        values = DEMONSTRATION[name]
        group.add_argument(f"--{name}", nargs="+", default=values, help=f"{texts[name]} [{_shown(values)}]", **kind)
    text = "seeds for each: --seed and those after it [2]"
    group.add_argument("--seeds", default=2, help=text, **options(2))

    group = made.add_argument_group("results")
    group.add_argument("--out", default="results/sweep", metavar="DIR", help="folder to write [results/sweep]")
    group.add_argument("--overwrite", action="store_true", help="replace the results that the folder holds")
    text = "evaluation episodes, by the policy's mode [100]"
    group.add_argument("--episodes", default=100, help=text, **options(100))
    group.add_argument("-h", "--help", action="help", help="show this and exit")

    groups = {name: made.add_argument_group(title) for name, title in TITLES.items()}
    for field in dataclasses.fields(Config):
        if field.name in GRID or not field.metadata.get("flag", True):
            continue
        name = field.metadata.get("group", "other")
        if name not in groups:
            groups[name] = made.add_argument_group(name)
        text = field.metadata.get("help", "") + ("" if field.default is None else f" [{_shown(field.default)}]")
        flag = f"--{field.name.replace('_', '-')}"
        groups[name].add_argument(flag, default=field.default, help=text.replace("%", "%%"), **options(field.default))
    return made


def request(arguments: Sequence[str]) -> Request:
    """Reads and checks a command line.

    Raises:
      ValueError: a value makes no sense; one line says which and what would be right.
      SystemExit: a flag that doesn't exist or can't be read (code 2), or --help (code 0).
    """
    settings = vars(parser().parse(arguments))
    settings = {name: tuple(value) if isinstance(value, list) else value for name, value in settings.items()}
    for name in ("seeds", "episodes"):
        if not 1 <= settings[name] <= MOST:
            raise ValueError(f"{name} {settings[name]} is out of range: choose 1 to {MOST}")
    last = 2**31 - settings["seeds"]  # a cell's seed is a 32-bit number
    if not 0 <= settings["seed"] <= last:
        raise ValueError(f"seed {settings['seed']} is out of range: choose 0 to {last}")
    for name in GRID:
        settings[name] = tuple(dict.fromkeys(settings[name]))
    fields = [field.name for field in dataclasses.fields(Config) if field.name in settings and field.name not in GRID]
    fixed = {name: settings[name] for name in fields}

    cells, trainings = [], {}
    seeds = range(settings["seed"], settings["seed"] + settings["seeds"])
    for env, method, lam in itertools.product(*(settings[name] for name in GRID)):
        config = Config(**(fixed | {"env": env, "method": method, "lam": lam}))
        check(config)
        for seed in seeds:
            own = f"lam{lam}-" if methods.get(method).uses_lam else ""
            cells.append(Cell(env, method, lam, seed, training=f"{env}-{method}-{own}seed{seed}"))
            trainings.setdefault(cells[-1].training, config.replace(seed=seed))
    out = Path(settings["out"])
    _check_folder(out, settings.pop("overwrite"))
    return Request(cells, trainings, settings, settings["episodes"], out)


def _check_folder(out: Path, overwrite: bool) -> None:
    if results.holds_results(out) and not overwrite:
        raise ValueError(
            f"out {str(out)!r} holds another run's results: choose another folder, or add --overwrite to replace them"
        )
    check_writable(out)


def check_writable(out: Path) -> None:
    """Raises ValueError, in one line, if no folder can be made or written at `out`."""
    existing = next(path for path in (out, *out.absolute().parents) if path.exists())
    if not existing.is_dir():
        raise ValueError(f"out {str(out)!r} can't be a folder: {str(existing)!r} is a file; choose another name")
    if not os.access(existing, os.W_OK):
        raise ValueError(
            f"out {str(out)!r} can't be written: {str(existing)!r} doesn't allow it; choose another folder"
        )


# --- what is shown --------------------------------------------------------------------------------------------------------


class Display:
    """Progress on stderr: a bar on a terminal, a line now and then elsewhere."""

    def __init__(self, total: int):
        from rich.console import Console, Group
        from rich.live import Live
        from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn
        from rich.text import Text

        self._total, self._done, self._figures, self._doing = total, 0, "", ""
        console = Console(stderr=True)
        columns = (TextColumn("{task.description}"), BarColumn(None), TaskProgressColumn(), TimeRemainingColumn())
        self._bar = Progress(*columns, speed_estimate_period=120, expand=True)
        self._task = self._bar.add_task("", total=total)
        shown = lambda: Group(self._bar, Text(self._figures))
        self._live = Live(get_renderable=shown, console=console) if console.is_terminal else None
        self._before, self._started = 0, 0.0  # steps and clock at the batch's start
        self._printed = 0.0  # clock at the last line
        self._latest = {"return_": float("nan"), "explicability": float("nan")}

    def __enter__(self) -> Display:
        if self._live:
            self._live.start(refresh=True)
        return self

    def __exit__(self, *exception: Any) -> None:
        if self._live:
            self._live.stop()

    def say(self, text: str) -> None:
        """What happens now."""
        self._doing = text
        self._bar.update(self._task, description=text)
        if not self._live:
            print(text, file=sys.stderr, flush=True)

    def begin(self, text: str) -> None:
        """A batch starts to run."""
        self.say(text)
        self._before, self._started = self._done, time.perf_counter()
        self._printed = self._started

    def progress(self, env_steps: int, curves: dict[str, np.ndarray]) -> None:
        """`env_steps` more are done, and what their episodes were like on average."""
        self._done += env_steps
        for name in self._latest:
            seen = curves[name][np.isfinite(curves[name])]
            self._latest[name] = seen.mean() if seen.size else self._latest[name]
        now = time.perf_counter()
        speed = (self._done - self._before) / (now - self._started)
        returns, explicability = self._latest["return_"], self._latest["explicability"]
        self._figures = f"{speed:,.0f} steps/s, return {returns:.1f}, explicability {explicability:.1f}"
        self._bar.update(self._task, completed=self._done)
        if not self._live and (now - self._printed > PATIENCE or self._done == self._total):
            self._printed = now
            share, left = 100 * self._done / self._total, (self._total - self._done) / speed
            print(f"{self._doing}: {share:.0f} %, {left:.0f} s left, {self._figures}", file=sys.stderr, flush=True)


def print_table(rows: Sequence[Row]) -> None:
    """A line for each world, method and lambda: mean and standard deviation over the seeds that didn't fail."""
    from rich import box
    from rich.console import Console
    from rich.table import Table

    table = Table(box=box.SIMPLE_HEAD, pad_edge=False, collapse_padding=True)
    for name in ("env", "method", "lambda"):
        table.add_column(name)
    records_of = {row.cell.training: results.record(row) for row in rows}
    rates = list(dict.fromkeys(name for record in records_of.values() for name in record if name.endswith("_rate")))
    events = (name.removesuffix("_rate").replace("_", " ") for name in rates)
    for name in ("return", "explicability", *events, "seeds"):
        table.add_column(name, justify="right", no_wrap=True)
    groups: dict[tuple[str, str, str], list[Row]] = {}
    for row in rows:
        lam = f"{row.cell.lam:g}" if methods.get(row.cell.method).uses_lam else "any"
        groups.setdefault((row.cell.env, row.cell.method, lam), []).append(row)
    for key, members in groups.items():
        trainings = {row.cell.training: row for row in members}.values()
        records = [records_of[row.cell.training] for row in trainings if not row.finished.failed]
        failed = len(trainings) - len(records)
        seeds = f"{len(records)}" + (f", {failed} failed" if failed else "")
        figures = (_spread(records, name) for name in ("return_mean", "explicability_mean"))
        table.add_row(*key, *figures, *(_rate(records, name) for name in rates), seeds)
    Console(width=None if sys.stdout.isatty() else 120).print(table)


def _spread(records: Sequence[dict[str, Any]], name: str) -> str:
    values = [record[name] for record in records]
    return f"{np.mean(values):.1f} ± {np.std(values):.1f}" if values else "–"


def _rate(records: Sequence[dict[str, Any]], name: str) -> str:
    values = [record[name] for record in records if name in record]
    return f"{100 * np.mean(values):.0f} %" if values else "–"


# --- what is done ---------------------------------------------------------------------------------------------------------


class Sweep:
    """A request on its way: what is finished, and its folder."""

    def __init__(self, wanted: Request, command: str):
        self._wanted = wanted
        self._names, self._configs = list(wanted.trainings), list(wanted.trainings.values())
        self.batches = batch.plan(self._configs, wanted.episodes)
        self._writer = results.Writer(wanted.out, command, wanted.settings)
        self._finished: dict[str, batch.Finished] = {}
        self._times, self._env_steps = batch.Times(), 0

    def rows(self) -> list[Row]:
        """The finished cells, in the grid's order."""
        finished = self._finished
        return [Row(cell, finished[cell.training]) for cell in self._wanted.cells if cell.training in finished]

    def save(self, status: str) -> None:
        """Writes what is finished."""
        if self._finished:
            self._writer.save(self.rows(), self._times, self._env_steps, status)

    def run(self) -> None:
        """Runs batch by batch, and saves after each."""
        self._wanted.out.mkdir(parents=True, exist_ok=True)
        train_batches(self._configs, self.batches, self._wanted.episodes, self._keep)
        self.save("complete")

    def _keep(self, places: Sequence[int], finished: Sequence[batch.Finished], times: batch.Times) -> None:
        self._finished |= {self._names[place]: cell for place, cell in zip(places, finished, strict=True)}
        self._times += times
        self._env_steps += sum(_steps(self._configs[place]) for place in places)
        self.save("running")


Keep = Callable[
    [Sequence[int], Sequence[batch.Finished], batch.Times], None
]  # places in the list, their cells, seconds


def train_batches(configs: Sequence[Config], batches: Sequence[batch.Batch], episodes: int, keep: Keep) -> None:
    """Trains and evaluates `configs` as `batches` divide them, with progress on stderr; `keep` gets each batch when it is done."""
    with Display(sum(map(_steps, configs))) as display:
        for number, current in enumerate(batches, 1):
            cells = [configs[place] for place in current.cells]
            name = f"{cells[0].method}, {len(cells)} cells" + f", batch {number}/{len(batches)}" * (len(batches) > 1)
            display.say(f"compiling {name}")
            program, compiling = batch.program(cells[0], current, episodes)
            display.begin(f"training {name}")
            share = len(cells) * cells[0].steps_per_round
            report = lambda done, curves, share=share: display.progress(share * _rounds(curves), curves)
            finished, running = program.run(cells, report)
            keep(current.cells, finished, compiling + running)


def _steps(config: Config) -> int:
    """Environment steps of a training."""
    return config.num_rounds * config.steps_per_round


def _rounds(curves: dict[str, np.ndarray]) -> int:
    return next(iter(curves.values())).shape[1]


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command line; returns the exit code."""
    use_every_core()
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    try:
        wanted = request(arguments)
        sweep = Sweep(wanted, shlex.join([*PROG.split(), *arguments]))
    except ValueError as error:
        print(f"{PROG}: error: {' '.join(str(error).split())}", file=sys.stderr)
        return 2
    try:
        sweep.run()
        rows = sweep.rows()
        pictures = _draw(rows, wanted.out)
    except KeyboardInterrupt:
        sweep.save("interrupted")
        kept = f"{len(sweep.rows())} of {len(wanted.cells)} cells are finished"
        print(
            f"\nstopped: {kept}" + (f" and kept in {wanted.out}" if sweep.rows() else "; nothing to keep"),
            file=sys.stderr,
        )
        return 130
    print_table(rows)
    failed = sum(row.finished.failed for row in rows)
    if failed:
        print(f"{failed} of {len(rows)} cells failed: something learned or evaluated is not finite")
    print(
        f"in {wanted.out}: {results.TABLE}, {results.CURVES}, {results.MANIFEST}, {results.CELLS}/, {', '.join(pictures)}"
    )
    print(f"go on with: peps_jax.load({str(wanted.out)!r}, {wanted.cells[0].name!r})")
    return 0


def _draw(rows: Sequence[Row], folder: Path) -> list[str]:
    from peps_jax import plots  # matplotlib takes its time

    print("drawing", file=sys.stderr)
    return [path.name for path in plots.draw(rows, folder)]


if __name__ == "__main__":
    sys.exit(main())
