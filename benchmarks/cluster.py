"""What a larger sweep costs, from the times of one that was run; writes benchmarks/results/cluster.md.

    python benchmarks/cluster.py results/sweep --runs 10000 --devices 16 64 256

A device is what the measured sweep's manifest lists: a CPU's core, or an accelerator.
"""

from __future__ import annotations

import argparse
import json
import math
import pathlib
from collections.abc import Mapping
from typing import Any, NamedTuple

from peps_jax.storage.tables import markdown

FILE = pathlib.Path(__file__).parent / "results" / "cluster.md"


class Measured(NamedTuple):
    """A sweep that was run."""

    seconds: float  # of one device, for one training and its evaluation
    compile_seconds: float  # of each process
    env_steps: float  # of one training
    device: str


def measured(manifest: Mapping[str, Any]) -> Measured:
    """The cost of a training in the sweep that `manifest` tells of. Raises ValueError for one that isn't complete."""
    if manifest["status"] != "complete":
        raise ValueError(f"status {manifest['status']!r}: give a sweep that is complete")
    trainings = len({row["file"] for row in manifest["rows"]})
    devices = manifest["devices"]
    seconds = (manifest["run_seconds"] + manifest["evaluation_seconds"]) * len(devices) / trainings
    kind = f"{devices[0]['platform']} {devices[0]['kind']}"
    return Measured(seconds, manifest["compile_seconds"], manifest["env_steps"] / trainings, kind)


def hours(one: Measured, runs: int, devices: int) -> float:
    """Of wall clock: every device works through its share, and every process compiles for itself."""
    return (math.ceil(runs / devices) * one.seconds + one.compile_seconds) / 3600


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("folder", type=pathlib.Path, help="of a sweep that was run")
    parser.add_argument("--runs", type=int, default=10_000, help="trainings of the larger one [10000]")
    parser.add_argument("--devices", type=int, nargs="+", default=[16, 64, 256, 1024], help="that share them")
    arguments = parser.parse_args()
    one = measured(json.loads((arguments.folder / "manifest.json").read_text(encoding="utf-8")))
    lines = [
        f"{arguments.runs:,} trainings of {one.env_steps:,.0f} environment steps; measured: "
        f"{one.seconds:.1f} s for one on one device ({one.device}), {one.compile_seconds:.0f} s of compilation.",
        "",
    ]
    rows = []
    for devices in arguments.devices:
        time = hours(one, arguments.runs, devices)
        rows.append([f"{devices:,}", f"{time:,.2f}", f"{time * devices:,.0f}"])
    lines.append(markdown(["devices", "hours", "device hours"], rows))
    FILE.write_text("\n".join(lines), encoding="utf-8")
    print(FILE.read_text(encoding="utf-8"))


if __name__ == "__main__":
    main()
