"""Which trainings and planned routes an evaluation is made of, and how those that are missing are made.

A training is named for its environment, its method, what it changes of the plan's settings, and its seed: tables and figures
that ask for the same one share it.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np

import peps_envs
from peps_jax.analysis import navigation_planner
from peps_jax.analysis.surrogate_maps import has_map, surrogate_values
from peps_jax.config import Config
from peps_jax.evaluate import evaluate
from peps_jax.execution import batches
from peps_jax.execution.program import FinishedRun, Times
from peps_jax.execution.progress import Display
from peps_jax.execution.waiting import Reminder
from peps_jax.reproduce.store import ROUTES, Record, Store, code_of, episodes, settings_of
from peps_jax.train import check

DOMAINS = ("nav-d1", "nav-d2", "nav-d3", "nav-d4")
METHODS = ("peps", "sac", "drlhp", "policy_shaping", "human_expectation")  # Figure 2's
BASELINES = ("sac", "drlhp", "policy_shaping")
FEW_SEEDS = 3  # of what is beside Table 1 and the figures of its trainings
# of the planner, for each objective: noise acts in the believed dynamics alone, and there a few points would miss its tails
PLANNER = {
    "return": dict(points=1, resolution=121),
    "peps": dict(points=1, resolution=121),
    "human": dict(points=7, resolution=61),
}


class Need(Protocol):
    """Something that takes long, is made once, and is kept by its name."""

    @property
    def name(self) -> str: ...

    @property
    def recipe(self) -> dict[str, Any]:
        """What decides its numbers, as JSON knows it."""

    def of(self, arrays: Mapping[str, np.ndarray]) -> Any:
        """What a file's arrays were made of: a record, which has `arrays()`."""


class Alone(Need, Protocol):
    """What is made by itself; trainings are made in batches."""

    @property
    def doing(self) -> str:
        """What is going on while it is made."""

    def make(self, num_episodes: int) -> Any:
        """The record."""


class View(Protocol):
    """What a figure needs of a finished training beside its scores. Equal ones look at the same."""

    @property
    def recipe(self) -> dict[str, Any]:
        """What decides its numbers."""

    def of(self, run: FinishedRun) -> dict[str, np.ndarray]:
        """What is kept, by its names."""


class Training(NamedTuple):
    """A training by its name."""

    name: str
    config: Config
    bias: float = 1.0  # strength of the belief's error
    view: View | None = None

    @property
    def recipe(self) -> dict[str, Any]:
        """What decides its numbers; a belief follows from its environment and the strength of its error."""
        told = settings_of(self.config.replace(belief=None)) | ({} if self.bias == 1 else {"bias": self.bias})
        own = code_of(peps_envs.make(self.config.env).environment)
        return told | ({} if own is None else {"code": own}) | ({} if self.view is None else {"view": self.view.recipe})

    def of(self, arrays: Mapping[str, np.ndarray]) -> Record:
        return Record.of(arrays)


class Planned(NamedTuple):
    """A route of the known-model planner; lambda matters to "peps" alone."""

    env: str
    objective: str
    lam: float
    gamma: float
    bias: float = 1.0  # strength of the belief's error

    @property
    def name(self) -> str:
        lam = f"-lam{self.lam:g}" * (self.objective == "peps")
        return f"{self.env}-planner-{self.objective}{lam}{_told(self.bias)}"

    @property
    def recipe(self) -> dict[str, Any]:
        """What decides its numbers."""
        told = {name: value for name, value in self._asdict().items() if name != "bias" or value != 1}
        return told | PLANNER[self.objective]

    @property
    def doing(self) -> str:
        return f"planning {self.name}"

    def of(self, arrays: Mapping[str, np.ndarray]) -> Record:
        return Record.of(arrays)

    def make(self, num_episodes: int) -> Record:
        """The route of the exact plan."""
        start = time.perf_counter()
        task = peps_envs.make(self.env)
        belief = believed(self.env, self.bias)
        asked = task.environment, task.params, belief, self.objective, self.lam, num_episodes
        evaluation = jax.device_get(_plan_and_walk(*asked, gamma=self.gamma, **PLANNER[self.objective]))
        routes = evaluation.perceived[:ROUTES]
        return Record(episodes(evaluation), {}, routes, {}, failed=False, seconds=time.perf_counter() - start)


def believed(env: str, bias: float) -> Any:
    """The default belief about `env`, with its error `bias` times as strong: 0 is the truth, 1 the belief as it is.

    Truth and belief are joined by a line; what isn't negative in truth, such as a probability of being stuck, doesn't become so.
    """
    task = peps_envs.make(env)

    def at(truth: Any, belief: Any) -> Any:
        value = truth + bias * (belief - truth)
        return jnp.where(truth >= 0, jnp.maximum(value, 0), value)

    return jax.tree.map(at, task.params, task.beliefs[task.default_belief])


def _told(bias: float) -> str:
    return "" if bias == 1 else f"-bias{bias:g}"


Score = Callable[[Record], float]


class Plan:
    """A base configuration, a number of seeds, and the records so far."""

    def __init__(self, base: Config, seeds: int, num_episodes: int):
        self.base, self.seeds, self.num_episodes = base, seeds, num_episodes
        self._records: dict[str, Any] = {}

    def training(
        self, env: str, method: str, seed: int, bias: float = 1.0, view: View | None = None, **changes: Any
    ) -> Training:
        """The training of `method` in `env` with `changes` of the plan's settings; changes that change nothing don't count.

        `bias` is the strength of the belief's error, as in `believed`.
        """
        changes = {name: value for name, value in changes.items() if getattr(self.base, name) != value}
        told = "".join(f"-{name}-{value}" for name, value in changes.items())
        config = self.base.replace(env=env, method=method, seed=seed, **changes)
        if bias != 1:
            config = config.replace(belief=believed(env, bias))
        return Training(f"{env}-{method}{told}{_told(bias)}-seed{seed}", config, bias, view)

    def trainings(self, env: str, method: str, seeds: int | None = None, **changes: Any) -> list[Training]:
        """The trainings of the first `seeds` seeds; of all by default."""
        number = self.seeds if seeds is None else min(seeds, self.seeds)
        return [self.training(env, method, seed, **changes) for seed in range(number)]

    def planned(self, env: str, objective: str, lam: float | None = None, bias: float = 1.0) -> Planned:
        """A planned route, at the plan's lambda by default, for a belief whose error is `bias` times as strong."""
        lam = self.base.lam if lam is None or objective != "peps" else lam
        return Planned(env, objective, float(lam), float(self.base.gamma), float(bias))

    def record(self, what: Need) -> Any:
        """What came out of `what`: a `Record` of a training or a planned route."""
        return self._records[what.name]

    def records(self, trainings: Iterable[Training]) -> list[Record]:
        """Records of those `trainings` that didn't fail."""
        return [record for record in map(self.record, trainings) if not record.failed]

    def typical(self, trainings: Sequence[Training], score: Score) -> Training | None:
        """Of those that didn't fail, the one whose score is nearest to their median."""
        good = [training for training in trainings if not self.record(training).failed]
        middle = np.median([score(self.record(training)) for training in good]) if good else 0.0
        return min(good, key=lambda training: abs(score(self.record(training)) - middle), default=None)

    def missing(self, wanted: Sequence[Need], store: Store) -> list[Need]:
        """Takes in what `store` has of `wanted`; returns the rest, each once.

        Raises:
          ValueError: settings that make no sense, or a file that doesn't fit.
        """
        rest = {}
        for what in wanted:
            if isinstance(what, Training):
                check(what.config)
            if what.name not in self._records:
                arrays = store.load(what.name, what.recipe)
                if arrays is None:
                    rest[what.name] = what
                else:
                    self._records[what.name] = what.of(arrays)
        return list(rest.values())

    def batches(self, trainings: Sequence[Training]) -> list[batches.Batch]:
        """How `trainings` are divided. Raises OutOfMemoryError, a ValueError, if one doesn't fit."""
        configs = [training.config for training in trainings]
        return batches.plan(configs, self.num_episodes, most=batches.runs_soon_done(jax.devices()))

    def make(self, missing: Sequence[Need], store: Store) -> None:
        """Makes what is missing; each batch is kept as soon as it is done."""

        def keep(what: Need, record: Any) -> None:
            store.save(what.name, what.recipe, record.arrays())
            self._records[what.name] = record

        alone = [what for what in missing if not isinstance(what, Training)]
        for number, what in enumerate(alone, 1):
            print(f"{what.doing}, {number} of {len(alone)}", file=sys.stderr, flush=True)
            with Reminder(what.doing):
                record = what.make(self.num_episodes)
            keep(what, record)
        trainings = [what for what in missing if isinstance(what, Training)]

        def keep_batch(done: batches.Batch, finished: Sequence[FinishedRun], times: Times) -> None:
            seconds = (times.run + times.evaluate) / len(done.runs)
            own = [trainings[place] for place in done.runs]
            reduced = lambda training, run: _reduce(run, self.num_episodes, seconds, training.view)
            with ThreadPoolExecutor(len(done.devices)) as pool:  # whose cores have nothing else to do
                records = list(pool.map(reduced, own, finished))
            for training, record in zip(own, records, strict=True):
                keep(training, record)

        if trainings:
            configs = [training.config for training in trainings]
            divided = self.batches(trainings)
            with Display(configs, divided, keep_batch) as display:
                batches.run(configs, divided, self.num_episodes, display)


def _reduce(run: FinishedRun, num_episodes: int, seconds: float, view: View | None) -> Record:
    """What is kept of a finished training, its samples' evaluation and, where there is a map, r-hat over it among it."""
    mode = episodes(run.evaluation)
    problem = run.training.problem
    imagined = evaluate(run, num_episodes, problem=problem.replace(params=problem.belief))
    mode["believed_return"] = np.asarray(imagined.human_return, np.float32)
    heat = {}
    if run.surrogate is not None and has_map(run):
        heat = dict(zip(("learned", "true", "free"), surrogate_values(run), strict=True))
    return Record(
        mode=mode,
        sampled=episodes(evaluate(run, num_episodes, stochastic=True)),
        routes=np.asarray(run.evaluation.perceived[:ROUTES]),
        heat=heat,
        failed=run.failed,
        seconds=seconds,
        seen={} if view is None else view.of(run),
    )


_plan_and_walk = jax.jit(
    navigation_planner.walk, static_argnames=("environment", "objective", "num_episodes", "points", "resolution")
)
