"""How long a user of `make sweep` waits for a word, for the first picture and for the whole; writes results/first_picture.md.

    python benchmarks/first_picture.py

The default sweep on a machine that is set up, in fresh processes: cold, where no program was compiled before, and warm.
"""

from __future__ import annotations

import os
import pathlib
import subprocess
import sys
import tempfile
import threading
import time

import jax

from peps_jax.command_line import use_every_core
from peps_jax.storage.tables import markdown
from peps_jax.sweep.results import PICTURES

OUT = pathlib.Path(__file__).parent / "results" / "first_picture.md"
STARTS = ("cold", "warm")


def measure(out: pathlib.Path, cache: pathlib.Path) -> list[float]:
    """Seconds until the first word, the first picture, and the end."""
    environment = os.environ | {"PEPS_JAX_CACHE": str(cache)}
    start, drawn = time.perf_counter(), []

    def watch() -> None:
        while sweep.poll() is None and not drawn:
            time.sleep(0.05)
            if (out / PICTURES[0]).exists():
                drawn.append(time.perf_counter() - start)

    command = [sys.executable, "-m", "peps_jax.sweep", "--out", str(out)]
    with subprocess.Popen(command, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE) as sweep:
        watcher = threading.Thread(target=watch)
        watcher.start()
        sweep.stderr.read(1)
        word = time.perf_counter() - start
        sweep.stderr.read()
    watcher.join()
    if sweep.returncode:
        raise RuntimeError(f"the sweep ended with code {sweep.returncode}")
    return [word, *drawn, time.perf_counter() - start]


def main() -> None:
    use_every_core()
    with tempfile.TemporaryDirectory() as folder:
        place = pathlib.Path(folder)
        rows = [[start, *(f"{seconds:.1f}" for seconds in measure(place / start, place / "cache"))] for start in STARTS]
    table = markdown(["start", "first word, s", "first picture, s", "whole, s"], rows)
    text = f"{table}\n`make sweep` in a fresh process on {jax.device_count()} devices.\n"
    OUT.write_text(text, encoding="utf-8")
    print(text)


if __name__ == "__main__":
    main()
