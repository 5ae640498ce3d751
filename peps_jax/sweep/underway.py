"""A sweep on its way: who trains which batches, what is finished, and what is kept of it; in a folder that it owns."""

from __future__ import annotations

import contextlib
import sys
import threading
import time
from collections.abc import Callable, Mapping, Sequence

import jax
import numpy as np

from peps_jax.command_line import StoppedError
from peps_jax.execution import batches, checkpoints, machine, memory
from peps_jax.execution.devices import side_by_side
from peps_jax.execution.program import FinishedRun, Progress, Times, empty_progress
from peps_jax.execution.progress import Display, env_steps
from peps_jax.execution.waiting import Reminder
from peps_jax.preferences.data import PreferenceSet
from peps_jax.storage import files
from peps_jax.storage.ownership import Owner
from peps_jax.sweep import journal, results, workers
from peps_jax.sweep.arguments import Request
from peps_jax.sweep.results import Row

SHOWN_EVERY = 60.0  # s between two pictures of what is finished so far; the first is made as soon as there is something


class Sweep:
    """A request on its way: what is finished, and its folder, which is this sweep's from `begin` to `close`.

    Args:
      wanted: what is to be trained.
      team: the processes that share it.

    Raises:
      NotWrittenError: from whatever writes, if there is no room or no permission.
      OwnershipLostError: from whatever writes, if the folder is another's now.
    """

    def __init__(self, wanted: Request, team: workers.Team):
        self.owner = Owner(wanted.out, team.run)
        self.batches: dict[int, batches.Batch] = {}  # this process's, by number
        self._wanted, self._team = wanted, team
        self._configs = list(wanted.trainings.values())
        self._places = {name: place for place, name in enumerate(wanted.trainings)}
        self._writer = results.Writer(wanted.out, wanted.begun_by, wanted.settings)
        self._journal = journal.Journal(wanted.out, _about(wanted), wanted.settings["keep_answers"])
        self._finished: dict[str, FinishedRun] = {}
        self._times, self._env_steps = Times(), 0
        self._tables = checkpoints.Rhythm(1.0)
        self._plan = journal.Plan((), (), "")

    @property
    def recorded(self) -> PreferenceSet | None:
        """Preferences from which all trainings learn."""
        return self._wanted.preferences

    # who does what

    def begin(self) -> None:
        """Takes the folder, and shares out what is to be done; or waits until process 0 has done that.

        Raises:
          ValueError: the sweep doesn't fit in memory, or the folder is another's or doesn't hold what is to be continued.
        """
        if self._team.leads:
            with Reminder("planning what runs with what"):
                self._plan = self._share_out()
        else:
            self._plan = self._shared_out()
        share = self._plan.shares[self._team.index]
        self.batches = {number: self._batch(self._plan.batches[number]) for number in share}

    def _share_out(self) -> journal.Plan:
        """Plans the sweep, or reads the plan of the one to be continued, and shares out what is left."""
        running, resume = self._wanted.running, self._wanted.resume
        begun = None if resume else self._planned()
        # --resume begins a sweep where there is none: where one has died before it wrote anything, too
        plan = self.owner.claim(
            self._to_continue if resume else self._to_begin, running["resume"] or running["overwrite"]
        )
        try:
            with self.owner.writing():
                if begun is None:
                    left = [
                        number for number in range(len(plan.batches)) if not self._read(number, plan.batches[number])
                    ]
                else:
                    plan, left = begun, range(len(begun.batches))
                    journal.clear(self._wanted.out)
                shares = tuple(tuple(left[index :: self._team.count]) for index in range(self._team.count))
                plan = plan._replace(shares=shares, run=self._team.run)
                self._journal.begin(plan)
                self.save("running")
        except (Exception, KeyboardInterrupt):
            self.owner.release()
            raise
        return plan

    def _to_begin(self) -> None:
        """Raises ValueError if the folder holds what nobody asked to replace."""
        if not self._wanted.running["overwrite"]:
            results.check_free(self._wanted.out)

    def _to_continue(self) -> journal.Plan:
        """The plan of the sweep to be continued. Raises ValueError if there is nothing to continue."""
        if results.is_complete(self._wanted.out):
            raise ValueError(f"out {str(self._wanted.out)!r} is complete: another process has just finished it")
        return self._journal.plan()

    def _planned(self) -> journal.Plan:
        """A new sweep's plan. Raises OutOfMemoryError, a ValueError, if a run doesn't fit."""
        names = list(self._wanted.trainings)
        named = lambda one: journal.Planned(tuple(names[place] for place in one.runs), one.slots)
        return journal.Plan(tuple(map(named, self._divided())), (), "")

    def _divided(self) -> list[batches.Batch]:
        devices = jax.devices()
        free = None  # measured
        if self._team.neighbours > 1 and not side_by_side(devices):
            free = memory.available_bytes(devices) // self._team.neighbours
        most = batches.runs_soon_done(devices)
        return batches.plan(self._configs, self._wanted.episodes, devices, free, most, self._team.count, self.recorded)

    def _shared_out(self) -> journal.Plan:
        """Waits for process 0 to share out the batches. Raises ValueError if it doesn't."""
        out, wait = str(self._wanted.out), self._wanted.running["wait"]
        end = time.monotonic() + wait
        with Reminder(f"{self._team.name} waits for process 0 to share out the batches in {out!r}"):
            while time.monotonic() < end:
                with contextlib.suppress(ValueError):
                    plan = self._journal.plan()
                    if plan.run == self._team.run:
                        return plan
                if self._wanted.resume and results.is_complete(self._wanted.out):
                    # it wasn't when this process looked first: process 0 had little left to do, and did it
                    return journal.Plan((), ((),) * self._team.count, self._team.run)
                time.sleep(0.1)
        raise ValueError(
            f"out {out!r}: process 0 hasn't shared out the batches in {wait:g} s; see what it says, and that every process sees "
            "this folder (--wait says how long to wait)"
        )

    def _batch(self, planned: journal.Planned) -> batches.Batch:
        devices = tuple(jax.devices()[: planned.slots])
        slots = planned.slots
        if slots % len(devices):  # it was planned for another machine
            slots = -(-len(planned.trainings) // len(devices)) * len(devices)
        return batches.Batch(tuple(self._places[name] for name in planned.trainings), slots, devices)

    # what is finished

    def rows(self) -> list[Row]:
        """The finished rows, in the grid's order."""
        finished = self._finished
        return [Row(key, finished[key.training]) for key in self._wanted.keys if key.training in finished]

    @property
    def complete(self) -> bool:
        return len(self._finished) == len(self._configs)

    def save(self, status: str) -> None:
        """Writes tables of what is finished."""
        if self._team.leads:
            with self._tables.making():
                self._writer.save(self.rows(), self._times, self._env_steps, status)

    def keep(self, number: int, finished: Sequence[FinishedRun], times: Times) -> None:
        """Writes a batch that this process has finished."""
        runs = dict(zip(self._plan.batches[number].trainings, finished, strict=True))
        self._journal.commit(number, runs, times)
        # tables and pictures show none of the preferences, which are most of what a run leaves
        self._take({name: run.replace(preferences=None) for name, run in runs.items()}, times)

    def _take(self, runs: Mapping[str, FinishedRun], times: Times) -> None:
        self._finished |= runs
        self._times += times
        self._env_steps += sum(env_steps(run.config) for run in runs.values())
        if self._tables.due():
            self.save("running")

    def _read(self, number: int, planned: journal.Planned) -> bool:
        """Takes in a batch that is done; whether it is. One that is damaged isn't."""
        try:
            done = self._journal.done(number)
            if done is None:
                return False
            read = lambda name: results.read_run(
                self._wanted.out, name, self._wanted.trainings[name], self._wanted.episodes, done.runs[name]
            )
            runs = {name: read(name) for name in planned.trainings}
        except files.DamagedError as error:
            print(f"a file of batch {number} is damaged ({error}): it is trained again", file=sys.stderr)
            return False
        self._take(runs, done.times)
        return True

    # what runs

    def run(self, stop: threading.Event, show: Callable[[Sequence[Row]], None]) -> None:
        """Runs this process's batches, and takes in the others'.

        Args:
          show: called with what is finished, now and then.

        Raises:
          StoppedError: `stop` was set, and a checkpoint is made.
          IncompatibleError: a checkpoint that doesn't fit.
        """
        checkpoints.prepare()
        with Keeper(self, stop, show) as keeper:
            batches.run(self._configs, list(self.batches.values()), self._wanted.episodes, keeper, self.recorded)

    def gather(self, stop: threading.Event, others: workers.Others) -> dict[int, str]:
        """Takes in what the other processes finish, until all have ended; what went wrong, by process."""
        if self._team.count == 1 or not self._team.leads:
            return {}
        ends, end = {}, None
        left = {number for share in self._plan.shares[1:] for number in share}
        going_on = lambda: sorted({*range(1, self._team.count)} - ends.keys())
        batches_left = lambda: f"{len(left)} batch{'es' * (len(left) != 1)} left"
        with Reminder(lambda: f"process 0 waits for {workers.numbered(going_on())}, {batches_left()}"):
            while True:
                if stop.is_set():
                    raise StoppedError
                self.owner.check()
                ends = others.ends()
                left -= {number for number in left if self._read(number, self._plan.batches[number])}
                if not left or not going_on():
                    # a shared folder may show the file of a batch later than the sign that its process is done
                    end = time.monotonic() + workers.LATE if end is None else end
                    done = [index for index, how in ends.items() if how == workers.DONE]
                    late = {number for index in done for number in self._plan.shares[index]}
                    if not left & late or time.monotonic() > end:
                        return {index: how for index, how in ends.items() if how != workers.DONE}
                time.sleep(0.2)

    def checkpoints(self, number: int) -> checkpoints.Checkpoints:
        return self._journal.checkpoints(number, [self._configs[place] for place in self.batches[number].runs])

    def close(self) -> None:
        """Tables are written and pictures drawn: nothing is left to continue, and the folder is nobody's."""
        self.save("complete")
        journal.close(self._wanted.out)
        self.owner.release()


class Keeper(Display):
    """Progress on stderr; checkpoints, and every batch kept as soon as it is done, and shown now and then."""

    def __init__(self, sweep: Sweep, stop: threading.Event, show: Callable[[Sequence[Row]], None]):
        super().__init__(sweep._configs, list(sweep.batches.values()), name=sweep._team.name)
        self._sweep, self._stop, self._show = sweep, stop, show
        self._shows = checkpoints.Rhythm(SHOWN_EVERY, at_once=True)
        self._number_of = {one: number for number, one in sweep.batches.items()}
        self._rhythm = checkpoints.Rhythm(sweep._wanted.running["checkpoint_every"])

    def start(self, current: batches.Batch) -> Progress | None:
        self._sweep.owner.check()
        if self._stop.is_set():
            raise StoppedError
        self._checkpoints = self._sweep.checkpoints(self._number_of[current])
        first = self._configs[current.runs[0]]
        progress = self._checkpoints.latest(empty_progress(first, len(current.runs), self._sweep.recorded))
        self.begin(current, progress.rounds if progress else 0)
        return progress

    def advanced(
        self,
        current: batches.Batch,
        rounds: int,
        curves: dict[str, np.ndarray],
        snapshot: Callable[[], Progress],
    ) -> None:
        super().advanced(current, rounds, curves, snapshot)
        self._sweep.owner.check()  # not only when something is written: no hours for nothing
        if self._stop.is_set() or self._rhythm.due():
            with self._rhythm.making():
                self._checkpoints.save(snapshot())
        if self._stop.is_set():
            raise StoppedError

    def finished(self, current: batches.Batch, runs: Sequence[FinishedRun], times: Times) -> None:
        self._sweep.keep(self._number_of[current], runs, times)
        if self._sweep._team.leads and not self._sweep.complete and self._shows.due():
            rows, out = self._sweep.rows(), self._sweep._wanted.out
            self.say(f"drawing {len(rows)} of {len(self._sweep._wanted.keys)} rows, in {out}")
            with self._shows.making():
                self._show(rows)
            self._sweep.owner.check()  # that took a while


def _about(wanted: Request) -> dict[str, str]:
    """What has to be the same for a sweep to be continued."""
    told = machine.describe()
    versions = {name: told["versions"][name] for name in ("peps-jax", "jax", "jaxlib")}
    device = jax.devices()[0]
    numbers = journal.numbers_digest(list(wanted.trainings.values()), wanted.preferences)
    return versions | {
        "devices": f"{device.platform} {device.device_kind}",
        "configuration": files.json_digest([files.plain(wanted.settings), numbers]),
    }
