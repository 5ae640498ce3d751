"""A training's program: initialised, advanced and evaluated for many runs at once, compiled once for each structure.

Runs whose `Config`s differ only in traced leaves share a program; environments that share code do too, because their numbers
are leaves.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from peps_jax import generator, methods
from peps_jax.config import Config, capacity
from peps_jax.evaluate import Evaluation, evaluate
from peps_jax.execution import compilation_cache, devices, memory
from peps_jax.preferences import teachers
from peps_jax.preferences.data import PreferenceSet
from peps_jax.train import Result, TrainingState, finish, init, prepare, run_round

# What runs once isn't worth optimizing: it compiles in half the time, and takes a tenth of a second more.
QUICKLY = {"xla_backend_optimization_level": 0, "xla_cpu_use_fusion_emitters": False}
# But policies that act together try many actions at every step of an evaluation. It compiles in 2.6 s instead of 1.1, and the
# evaluation of two trainings takes 0.5 s instead of 2.5.
LESS_QUICKLY = QUICKLY | {"xla_backend_optimization_level": 1}
# A training is cut into chunks of rounds: progress, and a place to stop, between two of them.
REPORTS = 40  # at least
CHUNK = 32  # rounds in one at most


@struct.dataclass
class FinishedRun(Result):
    """A training that is done and evaluated, as numpy arrays."""

    evaluation: Evaluation | None = None
    failed: bool = struct.field(pytree_node=False, default=False)  # something learned or evaluated isn't finite


class Times(NamedTuple):
    """Seconds of wall clock."""

    compile: float = 0.0
    run: float = 0.0  # training, after compilation
    evaluate: float = 0.0

    def __add__(self, other: Times) -> Times:
        return Times(*(a + b for a, b in zip(self, other, strict=True)))


class Progress(NamedTuple):
    """A batch between two rounds, as numpy arrays: all that it takes to go on, in another process too."""

    rounds: int  # done
    state: TrainingState  # every leaf (runs, ...); random keys as their data
    curves: dict[str, np.ndarray]  # (runs, rounds) each
    seconds: float  # of training so far


Report = Callable[
    [int, dict[str, np.ndarray], Callable[[], Progress]], None
]  # rounds done, curves (runs, rounds of the chunk), and what makes the batch's `Progress`


# --- what one training is made of -------------------------------------------------------------------------------------------


def shared(config: Config) -> Config:
    """`config` with its task's code and numbers in place of names, so that environments which share code share a program."""
    problem = config.problem()
    return config.replace(env=problem.environment, params=problem.params, belief=problem.belief)


def roomy(config: Config) -> Config:
    """`shared`, with lengths as values beside the room that there is, so that trainings of other lengths share a program too.

    `train` of it would fill that room: it is for `begin`, `advance` and `score`.
    """
    return shared(config.with_room())


def structure(config: Config) -> Any:
    """What decides which program a run needs: equal for runs that differ only in the values of traced leaves."""
    leaves, tree = jax.tree.flatten(roomy(config))
    return tree, tuple(jnp.shape(leaf) for leaf in leaves)


def written(config: Config, *more: Any) -> str | None:
    """`structure` as text, for another process to recognise; None if code decides it that isn't this project's."""
    one = roomy(config)
    ours = [type(one.env), *(part for part in methods.get(one.method) if callable(part))]
    if any(part.__module__.split(".")[0] not in ("peps_jax", "peps_envs") for part in ours):
        return None
    leaves, tree = jax.tree.flatten(one)
    text = repr([tree, [(jnp.shape(leaf), str(jnp.result_type(leaf))) for leaf in leaves], *more])
    return (
        None if " at 0x" in text else text
    )  # an object, such as a compiled model, that no other process can tell by that


def stack(configs: Sequence[Config]) -> Config:
    """One `Config` whose every leaf has a leading axis of runs."""
    return devices.stack([roomy(config) for config in configs])


def begin(config: Config, recorded: PreferenceSet | None = None) -> TrainingState:
    """The state before the first round, whether or not anything was recorded before."""
    teacher = teachers.SYNTHETIC if recorded is None else teachers.recorded(recorded)
    return init(prepare(config, teacher), teacher)


def advance(state: TrainingState, span: jax.Array, config: Config) -> Any:
    """Rounds span[0] to span[1], the last one excluded, of at most `CHUNK`: state, and curves (CHUNK,), 0 after their end.

    The same program for any number of rounds, and whether or not anything was recorded before.
    """
    training = prepare(config)
    one_round = jax.jit(lambda state, index: run_round(state, index, training))  # traced once
    curves = jax.eval_shape(one_round, state, span[0])[1]
    nothing = jax.tree.map(lambda value: jnp.zeros((CHUNK, *value.shape), value.dtype), curves)

    def another(index: jax.Array, carry: Any) -> Any:
        state, curves = carry
        state, figures = one_round(state, index)
        place = index - span[0]
        write = lambda rows, row: jax.lax.dynamic_update_index_in_dim(rows, row, place, 0)
        return state, jax.tree.map(write, curves, figures)

    return jax.lax.fori_loop(span[0], span[1], another, (state, nothing))


def score(state: TrainingState, config: Config, num_episodes: int) -> Evaluation:
    """The evaluation of what was learned."""
    return evaluate(finish(state, {}, prepare(config)), num_episodes)


def empty_progress(config: Config, runs: int, recorded: PreferenceSet | None = None) -> TrainingState:
    """Shapes and types of the state of a `Progress` of `runs` runs like that of `config`."""
    shapes = jax.eval_shape(lambda config: _key_data(begin(config, recorded)), roomy(config))
    return jax.tree.map(lambda leaf: jax.ShapeDtypeStruct((runs, *leaf.shape), leaf.dtype), shapes)


def empty_finished(config: Config, num_episodes: int) -> tuple[TrainingState, Evaluation]:
    """Shapes and types of what a training by `config` and its evaluation leave, curves apart."""

    def finished(config: Config) -> tuple[TrainingState, Evaluation]:
        state = begin(config)
        return state, score(state, config, num_episodes)

    return jax.eval_shape(finished, roomy(config))


def memory_need(config: Config, num_episodes: int, recorded: PreferenceSet | None = None) -> memory.Need:
    """Predicts a run's bytes from shapes alone, without compiling.

    `state` is exact: agent, knowledge, preferences, replay and actors, by `jax.eval_shape` of `begin`. `working` walks the traced
    program of a round (and of the evaluation) and takes the largest sum of values that are in use at the same time, as if
    every operation wrote its result to memory, elementwise ones in place where they can. Measured against programs
    compiled for a CPU, `bytes_needed` of it is 1 to 14 % more than XLA reports (sac and peps, widths 32 to 256, minibatches
    of 64 and 256), and up to 23 % more where a chunk is a single round. Most of it are the minibatches of a round,
    updates_per_round * batch_size transitions.
    """
    shapes, num_episodes = _shapes_of(recorded), capacity(num_episodes)
    key = structure(config), num_episodes, tuple(shapes)
    if key not in _NEEDS:  # tracing takes seconds
        about = written(config, "memory", num_episodes, shapes)
        made = lambda: {"need": _memory_need(config, num_episodes, recorded)}
        _NEEDS[key] = compilation_cache.kept(about, made)["need"]
    return _NEEDS[key]


_NEEDS: dict[Any, memory.Need] = {}  # predicted in this process


def _memory_need(config: Config, num_episodes: int, recorded: PreferenceSet | None) -> memory.Need:
    one, indices = roomy(config), jnp.zeros(1, jnp.int32)
    one_round = lambda state, config: run_round(state, indices[0], prepare(config))
    try:
        state = jax.eval_shape(lambda config: begin(config, recorded), one)
        programs = [
            jax.make_jaxpr(one_round)(state, one),
            jax.make_jaxpr(lambda state, config: score(state, config, num_episodes))(state, one),
        ]
    except OverflowError:  # sizes that an index can't count
        return memory.Need(state=2**63, working=0)
    return memory.Need(
        state=sum(memory.size_of(leaf) for leaf in jax.tree.leaves(state)),
        working=max(memory.most_in_use(program.jaxpr) for program in programs),
    )


# --- programs -------------------------------------------------------------------------------------------------------------


def chunk_length(num_rounds: int) -> int:
    """Rounds between two reports of a training of `num_rounds`."""
    return min(max(1, num_rounds // REPORTS), CHUNK)


class Program:
    """A structure's training and evaluation, compiled for a number of runs on some devices.

    Args:
      config: any with the structure.
      slots: runs that it has room for.
      num_episodes: that it has room for in an evaluation.
      recorded: preferences that were given before, the same for every run.
    """

    def __init__(
        self,
        config: Config,
        slots: int,
        num_episodes: int,
        used: Sequence[jax.Device],
        recorded: PreferenceSet | None = None,
    ):
        self._config, self._slots, self._num_episodes, self._recorded = config, slots, num_episodes, recorded
        self._devices, self._sharding = tuple(used), devices.sharding(used)
        self._compiled: dict[str, Any] = {}

    def compile(self) -> float:
        """Compiles, or takes what was compiled before; returns the seconds that it took."""
        start = time.perf_counter()
        about = written(self._config, self._slots, self._num_episodes, _shapes_of(self._recorded))
        together = len(methods.get(self._config.method).rewards) > 1
        once = {"init": QUICKLY, "evaluate": LESS_QUICKLY if together else QUICKLY}
        options = once if self._devices[0].platform == "cpu" else {}
        self._compiled = compilation_cache.kept(about, self._lowered, self._devices, options)
        return time.perf_counter() - start

    def _lowered(self) -> dict[str, Any]:
        """The programs by name, not compiled yet."""
        leaves = self._shapes(stack([self._config] * self._slots))
        recorded = self._recorded
        over = lambda function, **which: devices.over_devices(function, self._devices, **which)
        span = jax.ShapeDtypeStruct((2,), jnp.int32)
        evaluation = lambda state, config: score(state, config, self._num_episodes)
        first = over(begin, whole=(1,)).lower(leaves, recorded)
        state = self._shapes(first.out_info)
        return {
            "init": first,
            "rounds": over(advance, whole=(1,), donate=(0,)).lower(state, span, leaves),
            "evaluate": over(evaluation).lower(state, leaves),
        }

    @property
    def bytes_used(self) -> int:
        """Of a device at most, as XLA reports it: arguments, results and what is in use between them."""
        figures = [compiled.memory_analysis() for name, compiled in self._compiled.items() if name != "init"]
        return max(
            one.argument_size_in_bytes + one.output_size_in_bytes - one.alias_size_in_bytes + one.temp_size_in_bytes
            for one in figures
        )

    def _shapes(self, tree: Any) -> Any:
        return jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=self._sharding), tree)

    def run(
        self,
        configs: Sequence[Config],
        num_episodes: int,
        report: Report = lambda *_: None,
        start: Progress | None = None,
    ) -> tuple[list[FinishedRun], Times]:
        """Trains and evaluates `configs`, at most `slots`, and tells `report` after every chunk of rounds.

        Args:
          configs: of one number of rounds.
          num_episodes: of the evaluation, at most as many as there is room for.
          start: how far the same runs were before; the numbers are those of a run without a break.
        """
        number, (num_rounds,) = len(configs), {config.num_rounds for config in configs}
        leaves = jax.device_put(stack(devices.padded(configs, self._slots)), self._sharding)
        began = time.perf_counter()
        if start is None:
            state, done, chunks, earlier = self._compiled["init"](leaves, self._recorded), 0, [], 0.0
        else:
            state, done, chunks, earlier = self._resumed(start), start.rounds, [start.curves], start.seconds
        while done < num_rounds:
            end = min(done + chunk_length(num_rounds), num_rounds)
            state, curves = self._compiled["rounds"](state, np.array([done, end], np.int32), leaves)
            chunks.append({name: values[:number, : end - done] for name, values in jax.device_get(curves).items()})
            done = end

            def snapshot(state: TrainingState = state, done: int = done) -> Progress:
                seconds = earlier + time.perf_counter() - began
                return Progress(done, _on_host(state, number), _joined(chunks), seconds)

            report(done, chunks[-1], snapshot)
        trained = time.perf_counter()
        evaluations = jax.device_get(self._compiled["evaluate"](state, leaves))
        evaluations = jax.tree.map(lambda episodes: episodes[:, :num_episodes], evaluations)
        learned = jax.device_get((state.agents, state.knowledge, state.preferences))
        times = Times(run=earlier + trained - began, evaluate=time.perf_counter() - trained)
        rows = (*learned, _joined(chunks), evaluations)
        own = lambda place: jax.tree.map(lambda values: values[place], rows)
        return [self._finished(config, *own(place)) for place, config in enumerate(configs)], times

    def _finished(self, config: Config, agents: Any, knowledge: Any, preferences: Any, curves: Any, evaluation: Any):
        return FinishedRun(
            training=prepare(config),
            agents=agents,
            knowledge=knowledge,
            preferences=preferences,
            curves=curves,
            evaluation=evaluation,
            failed=not _finite((agents, knowledge, evaluation)),
        )

    def _resumed(self, start: Progress) -> TrainingState:
        """`start`'s state on the devices."""
        places = np.asarray(devices.padded(range(len(jax.tree.leaves(start.state)[0])), self._slots))
        shapes = jax.eval_shape(lambda config: begin(config, self._recorded), roomy(self._config))
        keys = lambda leaf, shape: generator.wrap(leaf) if _is_key(shape) else leaf
        state = jax.tree.map(keys, jax.tree.map(lambda leaf: leaf[places], start.state), shapes)
        return jax.device_put(state, self._sharding)


def _is_key(leaf: Any) -> bool:
    return jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def _key_data(state: TrainingState) -> TrainingState:
    return jax.tree.map(lambda leaf: jax.random.key_data(leaf) if _is_key(leaf) else leaf, state)


def _on_host(state: TrainingState, number: int) -> TrainingState:
    """The first `number` runs of `state` as numpy arrays."""
    return jax.tree.map(lambda leaf: np.array(leaf[:number]), jax.device_get(_key_data(state)))


def _joined(chunks: Sequence[dict[str, np.ndarray]]) -> dict[str, np.ndarray]:
    return jax.tree.map(lambda *parts: np.concatenate(parts, 1), *chunks)


def _finite(tree: Any) -> bool:
    return all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(tree) if np.issubdtype(leaf.dtype, np.floating))


def _shapes_of(recorded: PreferenceSet | None) -> list[Any]:
    return [(jnp.shape(leaf), str(jnp.result_type(leaf))) for leaf in jax.tree.leaves(recorded)]


MOST_PROGRAMS = (
    8  # in a process at once: each takes thousands of the memory mappings that Linux lets a process have (65 530)
)
_PROGRAMS: dict[Any, Program] = {}  # compiled in this process, the latest last


def program(
    config: Config,
    slots: int,
    num_episodes: int,
    used: tuple[jax.Device, ...],
    recorded: PreferenceSet | None = None,
) -> tuple[Program, Times]:
    """The compiled program for runs like that of `config`, and what it took: nothing if it was compiled before in this process."""
    num_episodes = capacity(num_episodes)  # the first ones are what fewer are
    key = structure(config), slots, used, num_episodes, id(recorded)
    found = _PROGRAMS.pop(key, None)
    made = Program(config, slots, num_episodes, used, recorded) if found is None else found
    seconds = made.compile() if found is None else 0.0
    _PROGRAMS[key] = made
    for oldest in list(_PROGRAMS)[:-MOST_PROGRAMS]:
        del _PROGRAMS[oldest]
    return made, Times(compile=seconds)
