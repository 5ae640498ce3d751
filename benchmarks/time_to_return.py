"""How long DRLHP trains on D1 until its mode returns `LEVEL`, ours and imitation's; writes results/time_to_return.md.

    python benchmarks/time_to_return.py

The teacher answers by r_A, 30 queries in 400 steps; a training on each core, at equal work (`equal_work`). Compilation and
evaluations are apart.
"""

from __future__ import annotations

import importlib
import pathlib
import sys
import time
from typing import Any, NamedTuple

import equal_work
import jax
import jax.numpy as jnp
import peer
import timing
from training import COMPARISONS, seeds_of

from peps_jax import Config
from peps_jax.command_line import use_every_core
from peps_jax.execution.program import begin, score, stack
from peps_jax.storage.tables import markdown
from peps_jax.train import TrainingState, prepare, run_rounds

sys.path.append(str(peer.SCRIPTS))
protocol: Any = importlib.import_module("protocol")  # the peers'

OUT = pathlib.Path(__file__).parent / "results" / "time_to_return.md"
WIDTH, EPISODES = 64, 16


class Reached(NamedTuple):
    """When a training's mode first returned as much, or what it returned at the end."""

    steps: int
    seconds: float
    value: float


def ours() -> tuple[list[Reached], float]:
    """Of a seed on each core, and the seconds of compilation."""
    config = equal_work.measured("drlhp", WIDTH).replace(belief="unbiased")
    configs = timing.spread(stack(seeds_of(config, jax.device_count())))
    spans = jnp.arange(protocol.WATCHED_EVERY, dtype=jnp.int32)

    def further(state: TrainingState, first: jax.Array, config: Config) -> TrainingState:
        return run_rounds(state, first + spans, prepare(config))[0]

    state = timing.compiled(begin, configs)[0](configs)
    at = lambda first: timing.spread(jnp.full(jax.device_count(), first, jnp.int32))
    advance, compilation = timing.compiled(further, state, at(0), configs)
    value, _ = timing.compiled(lambda *given: jnp.mean(score(*given, EPISODES).return_), state, configs)
    reached: list[Reached | None] = [None] * jax.device_count()
    seconds = 0.0
    for first in range(0, config.num_rounds, protocol.WATCHED_EVERY):
        start = time.perf_counter()
        state = jax.block_until_ready(advance(state, at(first), configs))
        seconds += time.perf_counter() - start
        steps = (first + protocol.WATCHED_EVERY) * config.steps_per_round
        now = [Reached(steps, seconds, float(each)) for each in value(state, configs)]
        print(now, flush=True)
        reached = [
            before or (one if one.value >= protocol.LEVEL else None) for before, one in zip(reached, now, strict=True)
        ]
        if all(reached):
            break
    return [one or last for one, last in zip(reached, now, strict=True)], compilation


def theirs() -> tuple[list[Reached], float]:
    """Of a seed on each core, and the seconds until it was ready. Raises Missing."""
    steps = equal_work.measured("drlhp", WIDTH).total_steps
    own = [["--width", WIDTH, "--steps", steps, "--seed", seed] for seed in range(len(peer.CORES))]
    said = peer.answers(COMPARISONS.name, "imitation_return.py", own)
    return [Reached(*one["returns"][-1]) for one in said], max(one["preparation"] for one in said)


def row(title: str, made: tuple[list[Reached], float]) -> list[str]:
    """A line of the table."""
    reached, before = made
    there = lambda one: "" if one.value >= protocol.LEVEL else " (not reached)"
    return [
        title,
        ", ".join(f"{one.value:.1f}{there(one)}" for one in reached),
        ", ".join(f"{one.steps:,}" for one in reached),
        ", ".join(f"{one.seconds:,.1f}" for one in reached),
        f"{before:.1f}",
    ]


def main() -> None:
    use_every_core()
    rows = [row("peps_jax", ours()), row(COMPARISONS.title, theirs())]
    head = ["program", "return of each seed's mode", "after steps", "seconds of training", "seconds before"]
    text = (
        f"{markdown(head, rows)}\nDRLHP on D1 until the mode returns {protocol.LEVEL:.0f} or more, looked at every "
        f"{protocol.WATCHED_EVERY} rounds of 400 steps, with 30 answers by r_A in each. A seed on each of "
        f"{jax.device_count()} cores. Before: compilation, or imports and a first training. imitation's episodes have one length, "
        "and its replay's rewards are r̂'s of now, as its authors advise.\n"
    )
    OUT.write_text(text, encoding="utf-8")
    print(text)


if __name__ == "__main__":
    main()
