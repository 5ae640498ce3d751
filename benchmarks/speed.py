"""How fast all of it is, beside others and beside what the machine could do; writes results/speed.{json,md,png}.

    make benchmark [ARGS="--quick"]

Environments alone (`environments`), SAC beside other libraries and PEPS (`training`), the parts of a round (`rounds`), matrix
products alone (`roofline`) and as networks make them (`layers`), and what more work costs (`growth`), in one run, so that ratios
mean something. Other libraries are installed on the first call (`peer`); one that can't be is a row that says so. `--quick` runs
a little of everything, into build/benchmark.
"""

from __future__ import annotations

import argparse
import json
import os
import pathlib
import platform
import time
from typing import Any

import jax

from peps_jax.command_line import print_whatever_can_be_shown, use_every_core

FOLDER = pathlib.Path(__file__).parent
SECTIONS = ("environments", "training", "roofline", "rounds", "layers", "growth")


def processor() -> str:
    """The processor's name."""
    try:
        lines = pathlib.Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        return next(line.split(":", 1)[1].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor() or platform.machine()


def measure(section: str, quick: bool) -> dict[str, Any]:
    """One section's record."""
    module = __import__(section)
    start = time.perf_counter()
    print(section, end=" ", flush=True)
    record = module.measure(quick)
    print(f"{time.perf_counter() - start:.0f} s", flush=True)
    return record


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--quick", action="store_true", help="a little of everything, whose numbers mean nothing")
    parser.add_argument(
        "--out", type=pathlib.Path, help="folder to write [benchmarks/results; --quick: build/benchmark]"
    )
    arguments = parser.parse_args()
    print_whatever_can_be_shown()
    use_every_core()
    if arguments.quick:  # nearly all of its time is compilation
        os.environ["XLA_FLAGS"] += " --xla_backend_optimization_level=0"
    out = arguments.out or (FOLDER.parent / "build/benchmark" if arguments.quick else FOLDER / "results")
    start = time.perf_counter()
    machine = {"processor": processor(), "devices": jax.device_count(), "python": platform.python_version(),
               "jax": jax.__version__}  # fmt: skip
    record = {"quick": arguments.quick, "machine": machine}
    out.mkdir(parents=True, exist_ok=True)
    save = lambda: (out / "speed.json").write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")
    for section in SECTIONS:
        record[section] = measure(section, arguments.quick)
        save()
    record["minutes"] = (time.perf_counter() - start) / 60

    import report

    record["ratios"] = report.ratios(record)
    save()
    (out / "speed.md").write_text(report.text(record), encoding="utf-8")
    report.draw(record, out / "speed.png")
    print(report.text(record))


if __name__ == "__main__":
    main()
