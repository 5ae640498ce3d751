"""Many runs at once: divided into batches, each with a structure of its own and small enough for the devices' memory."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

from peps_jax.config import Config
from peps_jax.execution import memory
from peps_jax.execution.devices import side_by_side
from peps_jax.execution.program import FinishedRun, Progress, Times, memory_need, program, structure
from peps_jax.preferences.data import PreferenceSet


class Batch(NamedTuple):
    """Runs that go together in one program."""

    runs: tuple[int, ...]  # places in the list that was planned
    slots: int  # runs that the program has room for, a multiple of its devices unless there are fewer runs
    devices: tuple[jax.Device, ...]


class Watch:
    """What a caller of `run` may want to hear. Does nothing by itself."""

    def compiling(self, batch: Batch) -> None:
        """A batch's program is about to be compiled."""

    def start(self, batch: Batch) -> Progress | None:
        """A batch's program is ready; returns where it goes on, None for the beginning."""

    def advanced(
        self, batch: Batch, rounds: int, curves: dict[str, np.ndarray], snapshot: Callable[[], Progress]
    ) -> None:
        """So many rounds of a batch are done, the last of them with these curves (runs, rounds)."""

    def finished(self, batch: Batch, runs: Sequence[FinishedRun], times: Times) -> None:
        """A batch is trained and evaluated."""


def runs_soon_done(devices: Sequence[jax.Device]) -> int | None:
    """`most` of `plan` for batches that are soon done and kept; None of devices that are quicker with many runs.

    A CPU's devices work on their runs one after the other anyway. With one for each, any number of runs has the same program.
    """
    return None if side_by_side(devices) else len(devices)


def plan(
    configs: Sequence[Config],
    num_episodes: int = 100,
    devices: Sequence[jax.Device] | None = None,
    free: int | None = None,
    most: int | None = None,
    shares: int = 1,
    recorded: PreferenceSet | None = None,
) -> list[Batch]:
    """Divides runs into batches: one structure and number of rounds each, and split further where they would not fit in memory.

    Args:
      devices: that share the runs; all by default.
      free: bytes that each device has; measured by default.
      most: runs in a batch at most, for a batch to be done and kept sooner; as many as fit by default.
      recorded: preferences that every training is given before it begins.
      shares: that the runs of each structure are at least cut into, for as many processes with such devices.

    Raises:
      OutOfMemoryError: one run for each device, or even a single one, is too much.
    """
    devices = tuple(jax.devices() if devices is None else devices)
    groups: dict[Any, list[int]] = {}
    for place, config in enumerate(configs):
        groups.setdefault((structure(config), config.num_rounds), []).append(place)
    batches = []
    for places in groups.values():
        used = devices[: -(-len(places) // shares)]
        room = memory.available_bytes(used) if free is None else free
        need = memory_need(configs[places[0]], num_episodes, recorded)
        fit = memory.runs_that_fit(need, room, side_by_side(used)) * len(used)
        if fit < 1:
            wanted, given = (
                memory.readable(size) for size in (need.working + 3 * need.state, memory.AVAILABLE_SHARE * room)
            )
            raise memory.OutOfMemoryError(
                f"a {configs[places[0]].method} run needs about {wanted} of memory and each of {len(used)} devices has {given} "
                "for it: lower total_steps, batch_size, updates_per_step, num_envs or the hidden sizes"
            )
        number = -(-len(places) // (fit if most is None else min(fit, most)))
        number = -(-number // shares) * shares  # every process as many
        per_device = -(-len(places) // (number * len(used)))  # batches of one size share one program
        slots = per_device * len(used)
        batches += [Batch(tuple(places[i : i + slots]), slots, used) for i in range(0, len(places), slots)]
    return batches


def run(
    configs: Sequence[Config],
    batches: Sequence[Batch],
    num_episodes: int,
    watch: Watch,
    recorded: PreferenceSet | None = None,
) -> None:
    """Trains and evaluates `configs` batch by batch, as `batches` divide them; `watch` gets each when it is done."""
    for batch in batches:
        watch.compiling(batch)
        compiled, compiling = program(configs[batch.runs[0]], batch.slots, num_episodes, batch.devices, recorded)
        start = watch.start(batch)
        report = functools.partial(watch.advanced, batch)
        finished, running = compiled.run([configs[place] for place in batch.runs], num_episodes, report, start)
        watch.finished(batch, finished, compiling + running)
