"""Whole trainings: SAC and DRLHP beside other libraries' at equal work, other ways of laying SAC over the machine, and PEPS."""

from __future__ import annotations

from typing import Any, NamedTuple

import equal_work
import jax
import peer
import timing

from peps_jax import Config, train
from peps_jax.execution.program import stack

WIDTHS = (64, 256)


class Library(NamedTuple):
    """A peer's SAC, and the environment steps of a process that take some seconds at each of `WIDTHS`."""

    title: str
    name: str
    script: str
    steps: tuple[int, int]


LIBRARIES = (
    Library("Stable-Baselines3 2.9", "sb3", "sb3_sac.py", (4_000, 2_000)),
    Library("SBX 0.28", "sbx", "sbx_sac.py", (16_000, 3_200)),
    Library("Brax 0.14.2", "brax", "brax_sac.py", (24_000, 4_000)),
    Library("rejax 0.1.3", "rejax", "rejax_sac.py", (32_000, 4_800)),
)
# the preference comparisons that one would pick otherwise, at the first of `WIDTHS`: a round of 400 steps takes it a minute
COMPARISONS = Library("imitation 1.0.1", "imitation", "imitation_drlhp.py", (800, 0))
QUICK_STEPS = 480


def shortened(config: Config, steps: int) -> Config:
    """`config` with fewer steps, and as many queries in each round as before."""
    short = config.replace(total_steps=steps)
    return short.replace(num_queries=config.queries_per_round * short.num_rounds)


def steps_of(config: Config) -> int:
    """Environment steps of a training."""
    return config.num_rounds * config.steps_per_round


def cost(
    configs: list[Config], devices: int | None = None, together: bool = False, repeats: int = 3
) -> dict[str, float]:
    """Trains all `configs`, of one structure: environment steps a second, summed over runs."""
    runs = timing.spread(stack(configs), devices)
    program, compilation = timing.compiled(train, runs, devices=devices, together=together)
    seconds = timing.seconds(program, runs, repeats=repeats)
    return {"rate": sum(map(steps_of, configs)) / seconds, "seconds": seconds, "compilation": compilation}


def seeds_of(config: Config, number: int) -> list[Config]:
    return [config.replace(seed=seed) for seed in range(number)]


def ours(method: str, width: int, steps: int, runs: int, **layout: Any) -> dict[str, float]:
    """`runs` trainings of D1 at the peers' work."""
    return cost(seeds_of(shortened(equal_work.measured(method, width), steps), runs), **layout)


def theirs(library: Library, width: int, steps: int, quick: bool) -> dict[str, Any]:
    """A peer's rate, or why there is none."""
    print(f"{library.title} at {width}", end=", ", flush=True)
    try:
        return peer.best(library.name, library.script, ("--width", width, "--steps", steps), quick)
    except peer.Missing as error:
        return {"missing": str(error)}


def measure(quick: bool) -> dict[str, Any]:
    """SAC at each width, and PEPS: ours, then the peers' on the same cores."""
    record: dict[str, Any] = {"sac": {}, "peps": {}, "layouts": {}}
    runs = 2 * jax.device_count()
    for place, width in enumerate(WIDTHS):
        steps = 800 if quick else (12_000, 3_200)[place]
        rows = record["sac"][str(width)] = {"peps_jax": ours("sac", width, steps, runs)}
        record["layouts"][str(width)] = {
            "side by side on each core": ours("sac", width, steps, runs, together=True, repeats=1)["rate"],
            "all cores for each training": ours("sac", width, steps, runs, devices=1, repeats=1)["rate"],
        }
        for library in LIBRARIES:
            rows[library.title] = theirs(library, width, QUICK_STEPS if quick else library.steps[place], quick)
    steps = 800 if quick else 12_000
    record["peps"]["64"] = ours("peps", 64, steps, runs)
    record["drlhp"] = {"peps_jax": ours("drlhp", 64, steps, runs)}
    if not quick:
        record["drlhp"][COMPARISONS.title] = theirs(COMPARISONS, 64, COMPARISONS.steps[0], quick=True)
    return record
