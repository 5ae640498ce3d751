"""Many cells at once: one compiled program for each structure, its cells laid over all devices.

Cells whose `Config`s differ only in traced leaves share a program; environments that share code do too, because their numbers
are leaves. On a CPU each device works through its cells one after the other, which is quicker than side by side (their
working memory stays in the cache); an accelerator takes its cells side by side.
"""

from __future__ import annotations

import functools
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding
from jax.sharding import PartitionSpec as P

from peps_jax import methods
from peps_jax.config import Config
from peps_jax.evaluate import Evaluation, evaluate
from peps_jax.execution import compilation_cache, memory
from peps_jax.train import Result, TrainingState, finish, init, run_round, run_rounds

REPORTS = 40  # chunks of rounds that a training is about cut into: progress, and a place to stop, between two of them
CELLS_PER_DEVICE = 5  # of a CPU in one batch at most, where it matters that a batch is soon done and kept


class Finished(NamedTuple):
    """A cell that was trained and evaluated, as numpy arrays."""

    result: Result
    evaluation: Evaluation
    failed: bool  # something that was learned or evaluated isn't finite


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
    state: TrainingState  # every leaf (cells, ...); random keys as their data
    curves: dict[str, np.ndarray]  # (cells, rounds) each
    seconds: float  # of training so far


Report = Callable[
    [int, dict[str, np.ndarray], Callable[[], Progress]], None
]  # rounds done, curves (cells, rounds of the chunk), and what makes the batch's `Progress`


class Batch(NamedTuple):
    """Cells that run together in one program."""

    cells: tuple[int, ...]  # places in the list that was planned
    slots: int  # cells that the program has room for, a multiple of its devices unless there are fewer cells
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
        """So many rounds of a batch are done, the last of them with these curves (cells, rounds)."""

    def finished(self, batch: Batch, cells: Sequence[Finished], times: Times) -> None:
        """A batch is trained and evaluated."""


def shared(config: Config) -> Config:
    """`config` with its task's code and numbers in place of names, so that worlds which share code share a program."""
    environment, params, belief = config.task()
    return config.replace(env=environment, params=params, belief=belief)


def structure(config: Config) -> Any:
    """What decides which program a cell needs: equal for cells that differ only in the values of traced leaves."""
    leaves, tree = jax.tree.flatten(shared(config))
    return tree, tuple(jnp.shape(leaf) for leaf in leaves)


def _written(config: Config, *more: Any) -> str | None:
    """`structure` as text, for another process to recognise; None if code decides it that isn't this project's."""
    cell = shared(config)
    ours = [type(cell.env), *(part for part in methods.get(cell.method) if callable(part))]
    if any(part.__module__.split(".")[0] not in ("peps_jax", "peps_envs") for part in ours):
        return None
    leaves, tree = jax.tree.flatten(cell)
    return repr([tree, [(jnp.shape(leaf), str(jnp.result_type(leaf))) for leaf in leaves], *more])


def stack(cells: Sequence[Config]) -> Config:
    """One `Config` whose every leaf has a leading axis of cells."""
    return jax.tree.map(
        lambda *leaves: jnp.asarray(np.stack([np.asarray(leaf) for leaf in leaves])), *map(shared, cells)
    )


# --- memory ---------------------------------------------------------------------------------------------------------------


def memory_need(config: Config, num_episodes: int) -> memory.Need:
    """Predicts a cell's bytes from shapes alone, without compiling.

    `state` is exact: agent, knowledge, replay and actors, by `jax.eval_shape` of `init`. `working` walks the traced
    program of a round (and of the evaluation) and takes the largest sum of values that are in use at the same time, as if
    every operation wrote its result to memory, elementwise ones in place where they can. Measured against programs
    compiled for a CPU, `bytes_needed` of it is 1 to 14 % more than XLA reports (sac and peps, widths 32 to 256, minibatches
    of 64 and 256), and up to 23 % more where a chunk is a single round. Most of it are the minibatches of a round,
    updates_per_round * batch_size transitions.
    """
    about = _written(config, "memory", num_episodes)
    return compilation_cache.kept(about, lambda: {"need": _memory_need(config, num_episodes)})["need"]


def _memory_need(config: Config, num_episodes: int) -> memory.Need:
    cell = shared(config)
    try:
        state = jax.eval_shape(init, cell)
        one_round = jax.make_jaxpr(run_round)(state, jnp.zeros((), jnp.int32), cell)
        scoring = jax.make_jaxpr(lambda state, cell: _evaluate(state, cell, num_episodes))(state, cell)
    except OverflowError:  # sizes that an index can't count
        return memory.Need(state=2**63, working=0)
    return memory.Need(
        state=sum(memory.size_of(leaf) for leaf in jax.tree.leaves(state)),
        working=max(memory.most_in_use(one_round.jaxpr), memory.most_in_use(scoring.jaxpr)),
    )


def side_by_side(devices: Sequence[jax.Device]) -> bool:
    """Whether a device works on its cells at the same time (`vmap`) or one after the other (`lax.map`)."""
    return devices[0].platform != "cpu"


def cells_soon_done(devices: Sequence[jax.Device]) -> int | None:
    """`most` of `plan` for batches that are soon done and kept; None of devices that are quicker with many cells."""
    return None if side_by_side(devices) else CELLS_PER_DEVICE * len(devices)


def plan(
    cells: Sequence[Config],
    num_episodes: int = 100,
    devices: Sequence[jax.Device] | None = None,
    free: int | None = None,
    most: int | None = None,
    shares: int = 1,
) -> list[Batch]:
    """Divides cells into batches: one structure each, and split further where they would not fit in memory.

    Args:
      devices: that share the cells; all by default.
      free: bytes that each device has; measured by default.
      most: cells in a batch at most, for a batch to be done and kept sooner; as many as fit by default.
      shares: that the cells of each structure are at least cut into, for as many processes with such devices.

    Raises:
      OutOfMemoryError: one cell for each device, or even a single one, is too much.
    """
    devices = tuple(jax.devices() if devices is None else devices)
    groups: dict[Any, list[int]] = {}
    for place, cell in enumerate(cells):
        groups.setdefault(structure(cell), []).append(place)
    batches = []
    for places in groups.values():
        used = devices[: -(-len(places) // shares)]
        room = memory.available_bytes(used) if free is None else free
        need = memory_need(cells[places[0]], num_episodes)
        fit = memory.cells_that_fit(need, room, side_by_side(used)) * len(used)
        if fit < 1:
            wanted, given = (
                memory.readable(size) for size in (need.working + 3 * need.state, memory.AVAILABLE_SHARE * room)
            )
            raise memory.OutOfMemoryError(
                f"a {cells[places[0]].method} cell needs about {wanted} of memory and each of {len(used)} devices has {given} "
                "for it: lower total_steps, batch_size, updates_per_step, num_envs or the hidden sizes"
            )
        number = -(-len(places) // (fit if most is None else min(fit, most)))
        number = -(-number // shares) * shares  # every process as many
        per_device = -(-len(places) // (number * len(used)))  # batches of one size share one program
        slots = per_device * len(used)
        batches += [Batch(tuple(places[i : i + slots]), slots, used) for i in range(0, len(places), slots)]
    return batches


# --- programs -------------------------------------------------------------------------------------------------------------


def _evaluate(state: TrainingState, cell: Config, num_episodes: int) -> tuple[Result, Evaluation]:
    result = finish(state, {}, cell)
    return result, evaluate(result, cell, num_episodes)


def chunk_lengths(num_rounds: int) -> list[int]:
    """Rounds between two reports, summing to `num_rounds`; of at most two different lengths, since each is a program.

    A length that divides `num_rounds` is taken unless it makes many more chunks than `REPORTS`.
    """
    longest = max(1, num_rounds // REPORTS)
    divisor = next(length for length in range(longest, 0, -1) if num_rounds % length == 0)
    length = divisor if 4 * divisor >= longest else longest
    rest = num_rounds % length
    return [length] * (num_rounds // length) + [rest] * (rest > 0)


class Program:
    """A structure's training and evaluation, compiled for a number of cells on some devices."""

    def __init__(self, cell: Config, slots: int, num_episodes: int, devices: Sequence[jax.Device]):
        self._devices = tuple(devices)
        self._sharding = NamedSharding(Mesh(np.asarray(devices), ("cells",)), P("cells"))
        self._slots = slots
        self._chunks = chunk_lengths(cell.num_rounds)
        start = time.perf_counter()
        about = _written(cell, slots, num_episodes)
        made = compilation_cache.kept(about, lambda: self._compile(cell, num_episodes), self._devices)
        self._init, self._evaluate = made["init"], made["evaluate"]
        self._advance = {length: made[f"{length} rounds"] for length in set(self._chunks)}
        self.compile_seconds = time.perf_counter() - start

    def _compile(self, cell: Config, num_episodes: int) -> dict[str, Any]:
        """The programs by name."""
        cells = self._shapes(stack([cell] * self._slots))
        state = self._shapes(jax.eval_shape(jax.vmap(init), cells))
        score = lambda state, cell: _evaluate(state, cell, num_episodes)
        lengths = sorted(set(self._chunks))
        advance = self._over_devices(run_rounds, whole=(1,), donate=(0,))
        indices = lambda length: jax.ShapeDtypeStruct((length,), jnp.int32)
        lowered = {
            "init": self._over_devices(init).lower(cells),
            "evaluate": self._over_devices(score).lower(state, cells),
            **{f"{length} rounds": advance.lower(state, indices(length), cells) for length in lengths},
        }
        with ThreadPoolExecutor() as pool:  # the compiler works outside Python's lock
            compiled = pool.map(lambda program: program.compile(), lowered.values())
            return dict(zip(lowered, compiled, strict=True))

    @property
    def bytes_used(self) -> int:
        """Of a device at most, as XLA reports it: arguments, results and what is in use between them."""
        figures = [compiled.memory_analysis() for compiled in (*self._advance.values(), self._evaluate)]
        return max(
            one.argument_size_in_bytes + one.output_size_in_bytes - one.alias_size_in_bytes + one.temp_size_in_bytes
            for one in figures
        )

    def _shapes(self, tree: Any) -> Any:
        return jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=self._sharding), tree)

    def _over_devices(
        self, function: Callable[..., Any], whole: tuple[int, ...] = (), donate: tuple[int, ...] = ()
    ) -> Any:
        """`function` of one cell, jitted for all: arguments and results have an axis of cells, but for arguments `whole`.

        What is whole stays unbatched inside, so that a round writes one slice of every replay and no scatter.
        """

        def on_device(*arguments: Any) -> Any:
            batched = [argument for place, argument in enumerate(arguments) if place not in whole]

            def one(batched: list[Any]) -> Any:
                rest = iter(batched)
                return function(
                    *(arguments[place] if place in whole else next(rest) for place in range(len(arguments)))
                )

            return jax.vmap(one)(batched) if side_by_side(self._devices) else jax.lax.map(one, batched)

        def on_all(*arguments: Any) -> Any:
            specs = tuple(P() if place in whole else P("cells") for place in range(len(arguments)))
            mapped = jax.shard_map(
                on_device, mesh=self._sharding.mesh, in_specs=specs, out_specs=P("cells"), check_vma=False
            )
            return mapped(*arguments)

        return jax.jit(on_all, donate_argnums=donate)

    def run(
        self, cells: Sequence[Config], report: Report = lambda *_: None, start: Progress | None = None
    ) -> tuple[list[Finished], Times]:
        """Trains and evaluates `cells`, at most `slots`, and tells `report` after every chunk of rounds.

        Args:
          start: where an earlier run of the same cells was; the numbers are those of a run without a break.
        """
        number = len(cells)
        leaves = jax.device_put(stack(self._padded(cells)), self._sharding)
        began = time.perf_counter()
        if start is None:
            state, done, chunks, earlier = self._init(leaves), 0, [], 0.0
        else:
            state, done, chunks, earlier = self._resumed(start, cells[0]), start.rounds, [start.curves], start.seconds
        for length in self._chunks[self.chunks_in(done) :]:
            state, curves = self._advance[length](state, jnp.arange(done, done + length, dtype=jnp.int32), leaves)
            chunks.append({name: values[:number] for name, values in jax.device_get(curves).items()})
            done += length

            def snapshot(state: TrainingState = state, done: int = done) -> Progress:
                seconds = earlier + time.perf_counter() - began
                return Progress(done, _on_host(state, number), _joined(chunks), seconds)

            report(done, chunks[-1], snapshot)
        trained = time.perf_counter()
        results, evaluations = jax.device_get(self._evaluate(state, leaves))
        times = Times(run=earlier + trained - began, evaluate=time.perf_counter() - trained)
        curves = _joined(chunks)
        finished = []
        for place, cell in enumerate(cells):
            own = jax.tree.map(lambda values: values[place], (results, evaluations, curves))  # noqa: B023, used at once
            result = own[0].replace(curves=own[2], config=cell)
            finished.append(Finished(result, own[1], failed=not _finite((own[0].agents, own[0].knowledge, own[1]))))
        return finished, times

    def chunks_in(self, rounds: int) -> int:
        """How many chunks `rounds` are. Raises ValueError if none ends there."""
        ends = np.cumsum([0, *self._chunks])
        if rounds not in ends:
            raise ValueError(f"rounds {rounds} end no chunk: chunks end at {', '.join(map(str, ends))}")
        return int(np.flatnonzero(ends == rounds)[0])

    def _padded(self, values: Sequence[Any]) -> list[Any]:
        """As many as there are slots, since every device gets as many: the last one again and again; dropped in the end."""
        return [*values, *[values[-1]] * (self._slots - len(values))]

    def _resumed(self, start: Progress, cell: Config) -> TrainingState:
        """`start`'s state on the devices."""
        places = np.asarray(self._padded(range(len(jax.tree.leaves(start.state)[0]))))
        shapes = jax.eval_shape(init, shared(cell))
        keys = lambda leaf, shape: jax.random.wrap_key_data(leaf) if _is_key(shape) else leaf
        state = jax.tree.map(keys, jax.tree.map(lambda leaf: leaf[places], start.state), shapes)
        return jax.device_put(state, self._sharding)


def _is_key(leaf: Any) -> bool:
    return jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def _on_host(state: TrainingState, number: int) -> TrainingState:
    """The first `number` cells of `state` as numpy arrays."""
    data = jax.tree.map(lambda leaf: jax.random.key_data(leaf) if _is_key(leaf) else leaf, state)
    return jax.tree.map(lambda leaf: np.array(leaf[:number]), jax.device_get(data))


def empty_progress(cell: Config, cells: int) -> TrainingState:
    """Shapes and types of the state of a `Progress` of `cells` cells like `cell`."""
    data = lambda config: jax.tree.map(lambda leaf: jax.random.key_data(leaf) if _is_key(leaf) else leaf, init(config))
    shapes = jax.eval_shape(data, shared(cell))
    return jax.tree.map(lambda leaf: jax.ShapeDtypeStruct((cells, *leaf.shape), leaf.dtype), shapes)


def empty_finished(cell: Config, num_episodes: int) -> tuple[Result, Evaluation]:
    """Shapes and types of what a training like `cell` and its evaluation leave, curves apart."""
    return jax.eval_shape(lambda config: _evaluate(init(config), config, num_episodes), shared(cell))


def _joined(chunks: Sequence[dict[str, np.ndarray]]) -> dict[str, np.ndarray]:
    return jax.tree.map(lambda *parts: np.concatenate(parts, 1), *chunks)


def _finite(tree: Any) -> bool:
    return all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(tree) if np.issubdtype(leaf.dtype, np.floating))


_PROGRAMS: dict[Any, Program] = {}  # compiled in this process, as `jax.jit` keeps its own


def program(cell: Config, batch: Batch, num_episodes: int) -> tuple[Program, Times]:
    """The program for `batch`, whose cells are like `cell`, and what it took: nothing if an earlier batch left it."""
    key = structure(cell), batch.slots, batch.devices, num_episodes
    if key in _PROGRAMS:
        return _PROGRAMS[key], Times()
    _PROGRAMS[key] = Program(cell, batch.slots, num_episodes, batch.devices)
    return _PROGRAMS[key], Times(compile=_PROGRAMS[key].compile_seconds)


def run(cells: Sequence[Config], batches: Sequence[Batch], num_episodes: int, watch: Watch) -> None:
    """Trains and evaluates `cells` batch by batch, as `batches` divide them; `watch` gets each when it is done."""
    for batch in batches:
        watch.compiling(batch)
        compiled, compiling = program(cells[batch.cells[0]], batch, num_episodes)
        start = watch.start(batch)
        report = functools.partial(watch.advanced, batch)
        finished, running = compiled.run([cells[place] for place in batch.cells], report, start)
        watch.finished(batch, finished, compiling + running)


def compile_over_devices(function: Callable[[Config], Any], configs: Sequence[Config]) -> tuple[Any, Config]:
    """The compiled program of any `function` for all `configs`, one at a time on each device, and what to call it with.

    Results have a leading axis of cells: the given ones, and then copies of the last that fill up the devices.
    """
    mesh, spec = jax.make_mesh((jax.device_count(),), ("cells",)), P("cells")
    padded = [*configs, *[configs[-1]] * (-len(configs) % jax.device_count())]
    cells = jax.device_put(stack(padded), NamedSharding(mesh, spec))
    on_device = lambda cells: jax.lax.map(function, cells)
    mapped = jax.shard_map(on_device, mesh=mesh, in_specs=spec, out_specs=spec, check_vma=False)
    return jax.jit(mapped).lower(cells).compile(), cells
