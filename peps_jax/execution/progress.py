"""What a command shows of its trainings while they run."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from peps_jax.config import Config
from peps_jax.execution import batches, program
from peps_jax.execution.program import FinishedRun, Times
from peps_jax.execution.waiting import Reminder, print_line

PATIENCE = 10.0  # s between two lines of progress where there is no terminal

Keep = Callable[[batches.Batch, Sequence[FinishedRun], Times], None]


def env_steps(config: Config) -> int:
    """Environment steps of a training."""
    return config.num_rounds * config.steps_per_round


class Display(batches.Watch):
    """Progress on stderr: a bar on a terminal, a line now and then elsewhere. What takes long without any says so.

    Args:
      configs: of all runs.
      batches: that are to be run.
      keep: gets each batch when it is done.
      name: of who speaks, where several processes do.
    """

    def __init__(
        self, configs: Sequence[Config], batches: Sequence[batches.Batch], keep: Keep = lambda *_: None, name: str = ""
    ):
        from rich.console import Console, Group
        from rich.live import Live
        from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn
        from rich.text import Text

        self._configs, self._batches, self._keep = configs, list(batches), keep
        self._name = f"{name}: " if name else ""
        self._total = sum(env_steps(configs[place]) for one in batches for place in one.runs)
        self._done, self._figures, self._doing = 0, "", ""
        console = Console(stderr=True)
        columns = (TextColumn("{task.description}"), BarColumn(None), TaskProgressColumn(), TimeRemainingColumn())
        self._bar = Progress(*columns, speed_estimate_period=120, expand=True)
        self._task = self._bar.add_task("", total=self._total)
        shown = lambda: Group(self._bar, Text(self._figures))
        self._live = Live(get_renderable=shown, console=console) if console.is_terminal and not name else None
        self._before, self._started = 0, 0.0  # steps and clock at the batch's start
        self._printed = float("-inf")  # clock at the last line
        self._said: set[str] = set()
        self._reminder = Reminder("beginning", self._remind)
        self._latest = {"return_": float("nan"), "explicability": float("nan")}

    def __enter__(self) -> Display:
        if self._live:
            self._live.start(refresh=True)
        self._reminder.__enter__()
        return self

    def __exit__(self, *exception: Any) -> None:
        self._reminder.__exit__()
        if self._live:
            self._live.stop()

    def say(self, text: str, number: str = "") -> None:
        """What happens now, and to which batch; of lines that differ in its `number` alone the first is printed."""
        self._doing = text + number
        self._bar.update(self._task, description=self._doing)
        self._reminder.about(self._doing)
        if not self._live and text not in self._said:
            print_line(f"{self._name}{self._doing}")
            self._said.add(text)
            self._printed = time.perf_counter()

    def _remind(self, text: str) -> None:
        if self._live:
            self._bar.update(self._task, description=text)
        else:
            print_line(f"{self._name}{text}")

    def compiling(self, batch: batches.Batch) -> None:
        self.say(f"compiling {self._described(batch)}", self._number(batch))

    def start(self, batch: batches.Batch) -> None:
        self.begin(batch, 0)

    def begin(self, batch: batches.Batch, rounds: int) -> None:
        """A batch starts to run, `rounds` of which an earlier run made."""
        since = f" from round {rounds} on" * (rounds > 0)
        self.say(f"training {self._described(batch)}{since}", self._number(batch))
        self._done += rounds * self._steps_per_round(batch)
        self._before, self._started = self._done, time.perf_counter()

    def finished(self, batch: batches.Batch, runs: Sequence[FinishedRun], times: Times) -> None:
        self._keep(batch, runs, times)

    def _described(self, batch: batches.Batch) -> str:
        return f"{self._configs[batch.runs[0]].method}, {len(batch.runs)} run" + "s" * (len(batch.runs) > 1)

    def _number(self, batch: batches.Batch) -> str:
        return f", batch {self._batches.index(batch) + 1}/{len(self._batches)}" * (len(self._batches) > 1)

    def _steps_per_round(self, batch: batches.Batch) -> int:
        return sum(self._configs[place].steps_per_round for place in batch.runs)

    def advanced(
        self, batch: batches.Batch, rounds: int, curves: dict[str, np.ndarray], snapshot: Callable[[], program.Progress]
    ) -> None:
        self._done += self._steps_per_round(batch) * next(iter(curves.values())).shape[1]
        ended = curves["episodes"] > 0
        for name in self._latest:
            seen = curves[name][ended]
            self._latest[name] = seen.mean() if seen.size else self._latest[name]
        now = time.perf_counter()
        speed = (self._done - self._before) / (now - self._started)
        returns, explicability = self._latest["return_"], self._latest["explicability"]
        self._figures = f"{speed:,.0f} steps/s, return {returns:.1f}, explicability {explicability:.1f}"
        self._bar.update(self._task, completed=self._done, description=self._doing)
        if not self._live and (now - self._printed > PATIENCE or self._done == self._total):
            self._printed = now
            share, left = 100 * self._done / self._total, (self._total - self._done) / speed
            print_line(f"{self._name}{self._doing}: {share:.0f} %, {left:.0f} s left, {self._figures}")
        if rounds == self._configs[batch.runs[0]].num_rounds:
            self._reminder.about(f"evaluating {self._described(batch)}{self._number(batch)}")
        else:
            self._reminder.about(f"{self._doing}: {rounds} rounds are done, the next ones take")
