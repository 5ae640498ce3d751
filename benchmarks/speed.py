"""Environment steps a second of a sweep's cells on D1, compile time apart; writes benchmarks/results/speed.md.

    make benchmark [ARGS="--cells 4 --steps 12000"]

16 environments, one SAC update per 4 steps, batch 256. SAC at two widths of two layers, and PEPS with its default models;
PEPS's rate is also given as a share of SAC's in the same run, and its time and memory for growing numbers of seeds.
"""

from __future__ import annotations

import argparse
import pathlib
import time
from typing import NamedTuple

import jax

from peps_jax import Config, train
from peps_jax.batch import compile_over_devices
from peps_jax.command_line import use_every_core

FOLDER = pathlib.Path(__file__).parent / "results"


class Cost(NamedTuple):
    """What a batch of trainings took."""

    seconds: float
    rate: float  # environment steps a second, summed over cells
    compilation: float  # s
    memory: float  # MB on all devices: arguments, results and what the program works with, as XLA reports them


def cost(config: Config, cells: int) -> Cost:
    """Trains `cells` seeds."""
    start = time.perf_counter()
    program, batch = compile_over_devices(train, [config.replace(seed=seed) for seed in range(cells)])
    compiled = time.perf_counter()
    jax.block_until_ready(program(batch))
    seconds = time.perf_counter() - compiled
    steps = cells * config.num_rounds * config.steps_per_round
    used = program.memory_analysis()
    per_device = used.argument_size_in_bytes + used.output_size_in_bytes + used.temp_size_in_bytes
    return Cost(seconds, steps / seconds, compiled - start, per_device * jax.device_count() / 1e6)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument(
        "--cells", type=int, default=4, help="trainings; twice the number of devices, or a multiple of that"
    )
    parser.add_argument("--steps", type=int, default=12_000, help="environment steps of a training")
    arguments = parser.parse_args()
    use_every_core()
    lines = ["| training | hidden layers | environment steps a second | compilation, s |", "|---|---|---|---|"]
    rates = {}
    for method, width, steps in (
        ("sac", 64, arguments.steps),
        ("sac", 256, arguments.steps // 4),
        ("peps", 64, arguments.steps),
    ):
        config = Config(env="nav-d1", method=method, hidden_sizes=(width, width), total_steps=steps)
        taken = cost(config, arguments.cells)
        rates[method, width] = taken.rate
        lines.append(f"| {method} | {width}, {width} | {taken.rate:,.0f} | {taken.compilation:.1f} |")
    lines += ["", f"PEPS runs at {rates['peps', 64] / rates['sac', 64]:.0%} of SAC's rate; {jax.device_count()} devices, "
              f"{arguments.cells} cells."]  # fmt: skip
    lines += ["", "| seeds of PEPS | seconds | seconds a seed | MB | MB a seed |", "|---|---|---|---|---|"]
    for seeds in (arguments.cells // 2, arguments.cells, 2 * arguments.cells, 4 * arguments.cells):
        taken = cost(Config(env="nav-d1", total_steps=arguments.steps), seeds)
        lines.append(
            f"| {seeds} | {taken.seconds:.1f} | {taken.seconds / seeds:.2f} | {taken.memory:.0f} | {taken.memory / seeds:.0f} |"
        )
    FOLDER.mkdir(exist_ok=True)
    (FOLDER / "speed.md").write_text("\n".join(lines) + "\n")
    print("\n".join(lines))


if __name__ == "__main__":
    main()
