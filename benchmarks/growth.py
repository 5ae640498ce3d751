"""What more seeds, environments, members and units cost, and what compiling costs a sweep."""

from __future__ import annotations

import json
import os
import pathlib
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from typing import Any

import equal_work
import jax
import timing
from training import seeds_of, shortened, steps_of

from peps_jax import Config, train
from peps_jax.execution.program import stack

ROUNDS = 8
MOST = 8  # runs in a program: a sweep of many keeps what it has, batch by batch
LARGEST = 256


def seconds_of(config: Config, runs: int, repeats: int = 3) -> float:
    """Of training so many seeds at the same time."""
    batched = timing.spread(stack(seeds_of(config, runs)))
    program, _ = timing.compiled(train, batched)
    return timing.seconds(program, batched, repeats=repeats)


def seeds(config: Config, most: int, repeats: int) -> dict[str, float]:
    """Seconds for 1, 2, 4, ... seeds: up to `MOST` in one program, more of them in batches of that."""
    taken, programs, size = {}, {}, 1
    devices = jax.device_count()
    while size <= most:
        inside = min(size, max(MOST, devices))
        filled = -(-inside // devices) * devices  # every device gets as many
        batched = timing.spread(stack(seeds_of(config, filled)))
        if filled not in programs:
            programs[filled], _ = timing.compiled(train, batched)
        calls = range(-(-size // inside))
        in_batches = lambda runs, program=programs[filled], calls=calls: [program(runs) for _ in calls]
        taken[str(size)] = timing.seconds(in_batches, batched, repeats=repeats if size <= MOST else 1)
        size *= 2
    return taken


def seconds_a_step(config: Config, repeats: int) -> float:
    """Of one environment step of one run, on every device at the same time."""
    return seconds_of(config, jax.device_count(), repeats) / steps_of(config)


def sizes(base: Config, values: dict[str, Sequence[int]], repeats: int) -> dict[str, dict[str, float]]:
    """Seconds a step for each size of each kind, the others as in `base`."""
    changed = {
        "environments": lambda size: base.replace(num_envs=size, total_steps=ROUNDS * base.rollout_length * size),
        "ensemble": lambda size: base.replace(ensemble_size=size),
        "width": lambda size: base.replace(hidden_sizes=(size, size)),
    }
    ordinary = seconds_a_step(base, repeats)
    usual = {"environments": base.num_envs, "ensemble": base.ensemble_size, "width": base.hidden_sizes[0]}
    return {
        kind: {
            str(size): ordinary if size == usual[kind] else seconds_a_step(changed[kind](size), repeats)
            for size in sorted({*sizes, usual[kind]})
        }
        for kind, sizes in values.items()
    }


def compilation() -> dict[str, float]:
    """Seconds that a sweep compiles in a fresh process: `cold`, and `warm` in the next, which finds what the first one kept."""
    with tempfile.TemporaryDirectory() as folder:
        home = pathlib.Path(folder)
        alone = {"PEPS_JAX_CACHE": str(home / "kept")}
        cold, warm = (_sweep(alone, home / name) for name in ("first", "again"))
    return {"cold": cold, "warm": warm}


def _sweep(surroundings: dict[str, str], out: pathlib.Path) -> float:
    """What a small sweep says it took to compile."""
    flags = {
        "env": "nav-d1",
        "method": "peps",
        "seeds": 2,
        "total-steps": 800,
        "num-queries": 60,
        "episodes": 2,
        "out": out,
    }
    command = [sys.executable, "-m", "peps_jax.sweep", *(f"--{name}={value}" for name, value in flags.items())]
    subprocess.run(command, check=True, capture_output=True, env=dict(os.environ) | surroundings)
    return json.loads((out / "manifest.json").read_text(encoding="utf-8"))["compile_seconds"]


def measure(quick: bool) -> dict[str, Any]:
    """Seconds for seeds; seconds a step for the other sizes; seconds of compilation."""
    base = equal_work.measured()
    base = shortened(base, ROUNDS * base.steps_per_round)
    repeats = 1 if quick else 3
    most = 4 if quick else LARGEST
    values = {"environments": (4,), "ensemble": (2,), "width": (32,)} if quick else {
        "environments": (4, 64), "ensemble": (2, 10), "width": (32, 128, 256),
    }  # fmt: skip
    return {
        "seeds": seeds(base, most, repeats),
        **sizes(base, values, repeats),
        "compilation": compilation(),
    }
