"""Other libraries, each in a virtual environment of its own, since their dependencies conflict, and how their scripts are run.

`peers/NAME.txt` holds a peer's pinned versions; its environment is made on the first call, under `.peers/NAME`.
"""

from __future__ import annotations

import json
import os
import pathlib
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from typing import IO, Any, NamedTuple

FOLDER = pathlib.Path(__file__).parent
SCRIPTS, HOMES = FOLDER / "peers", FOLDER / ".peers"
CORES = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else list(range(os.cpu_count() or 1))
PATIENCE = 1_800.0  # s that a script may take
TEXT = {"encoding": "utf-8", "errors": "replace"}  # how a script's output is read, whatever the locale


class Missing(Exception):
    """A peer can't be installed or run; one line says why."""


class Running(NamedTuple):
    """A script that was started."""

    process: subprocess.Popen
    errors: IO[str]  # what it complains of: in a file, which doesn't fill up as a pipe does


class Answer(NamedTuple):
    """What one or several processes of a script did at the same time."""

    rate: float  # steps a second, summed over processes
    preparation: float  # s until all were warm: imports and compilation


def python_of(name: str) -> pathlib.Path:
    """The interpreter that has peer `name`; its environment is made if it isn't there as the requirements ask.

    Raises:
      Missing: it could not be installed.
    """
    home, wanted = HOMES / name, (SCRIPTS / f"{name}.txt").read_text(encoding="utf-8")
    python, mark = home / "bin/python", home / "installed.txt"
    if mark.exists() and mark.read_text(encoding="utf-8") == wanted:
        return python
    print(f"installing {name}", flush=True)
    try:
        _call([sys.executable, "-m", "venv", "--clear", home])
        _call([python, "-m", "pip", "install", "--quiet", "--disable-pip-version-check", "-r", SCRIPTS / f"{name}.txt"])
    except OSError as error:
        raise Missing(str(error)) from None
    mark.write_text(wanted, encoding="utf-8")
    return python


def call(name: str, script: str, *arguments: object) -> str:
    """What `script` of peer `name` prints.

    Raises:
      Missing: it could not be installed or run.
    """
    return _call([python_of(name), "-W", "ignore", SCRIPTS / script, *arguments], _surroundings(name))


def answers(name: str, script: str, arguments: Sequence[Sequence[object]]) -> list[dict[str, Any]]:
    """What processes of a script that follows `peers/protocol.py` answer, each called with its own: warm together, timed together.

    One process has all cores; several have one each.

    Raises:
      Missing: it could not be installed or run.
    """
    python, running = python_of(name), []
    try:
        for process, own in enumerate(arguments):
            command = [python, "-W", "ignore", SCRIPTS / script, *own, "--wait"]
            running.append(_start(command, _surroundings(name), CORES if len(arguments) == 1 else [CORES[process]]))
        for started in running:
            _next_line(started, "ready")
        for started in running:
            started.process.stdin.write("go\n")
            started.process.stdin.flush()
        return [json.loads(_next_line(started, "{")) for started in running]
    finally:
        for started in running:
            started.process.kill()
            started.process.communicate()
            started.errors.close()


def measure(name: str, script: str, arguments: Sequence[object], processes: int) -> Answer:
    """The rate of `processes` of a script. Raises Missing."""
    said = answers(name, script, [arguments] * processes)
    rate = sum(answer["steps"] / answer["seconds"] for answer in said)
    return Answer(rate, max(answer["preparation"] for answer in said))


def best(name: str, script: str, arguments: Sequence[object], quick: bool = False) -> dict[str, Any]:
    """The faster of a process on each core and of one with all of them: its rate, and both ways' rates.

    `quick` doesn't try the second.
    """
    ways = {"a process per core": measure(name, script, arguments, len(CORES))}
    if len(CORES) > 1 and not quick:
        ways["one process"] = measure(name, script, arguments, 1)
    way = max(ways, key=lambda way: ways[way].rate)
    rates = {way: answer.rate for way, answer in ways.items()}
    return {"rate": ways[way].rate, "preparation": ways[way].preparation, "way": way, "ways": rates}


def _surroundings(name: str) -> dict[str, str]:
    """The environment variables of a script: CPU only, our environments importable, what JAX compiled kept for the next time."""
    ours = {
        "JAX_PLATFORMS": "cpu",
        "PYTHONPATH": str(FOLDER.parent / "envs"),
        "JAX_COMPILATION_CACHE_DIR": str(HOMES / name / "compiled"),
    }
    kept = {key: value for key, value in os.environ.items() if key not in ("XLA_FLAGS", "CUDA_VISIBLE_DEVICES")}
    return kept | ours


def _start(command: Sequence[object], surroundings: dict[str, str], cores: Sequence[int]) -> Running:
    pipe, errors = subprocess.PIPE, tempfile.TemporaryFile("w+", **TEXT)  # noqa: SIM115, it outlives this function
    pin = getattr(os, "sched_setaffinity", lambda process, cores: None)
    pin(0, cores)  # this thread's, which the process inherits
    try:
        process = subprocess.Popen(
            list(map(str, command)), stdin=pipe, stdout=pipe, stderr=errors, env=surroundings, **TEXT
        )
    finally:
        pin(0, CORES)
    return Running(process, errors)


def _next_line(started: Running, start: str) -> str:
    """The next line of output that begins with `start`; libraries print lines of their own."""
    for line in started.process.stdout:
        if line.startswith(start):
            return line
    started.errors.seek(0)
    raise Missing(_last_line(started.errors.read()))


def _call(command: Sequence[object], surroundings: dict[str, str] | None = None) -> str:
    command = list(map(str, command))
    done = subprocess.run(command, capture_output=True, env=surroundings, timeout=PATIENCE, check=False, **TEXT)
    if done.returncode:
        raise Missing(_last_line(done.stderr))
    return done.stdout


def _last_line(text: str | None) -> str:
    lines = (text or "").strip().splitlines()
    return lines[-1][:200] if lines else "it said nothing"
