"""A sweep over several processes has the files of one process, and one that fails takes nothing with it."""

import csv
import itertools
import json
import os
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
from commands import contents, exit_code

import peps_envs
from peps_jax.execution import batches, waiting
from peps_jax.storage import files
from peps_jax.sweep import command, meeting, pictures, results, workers

SIZES = [
    *("--num-envs", "4", "--rollout-length", "10", "--warmup-steps", "40", "--batch-size", "16"),
    *("--updates-per-step", "0.1", "--hidden-sizes", "8", "--model-hidden-sizes", "8", "--ensemble-size", "3"),
    *("--total-steps", "160", "--episodes", "4"),
]
LINE = ["--env", "line", "--method", "sac", "--seeds", "8", *SIZES]  # four batches of two runs


def call(*arguments: object) -> int:
    return exit_code(command.main, *arguments)


@pytest.fixture
def team(line, monkeypatch):
    """Threads in place of processes: whoever says which one it is has joined the others already."""
    task = peps_envs.Task(line.env, line.params, {"noisy": line.belief, "true": line.params})
    monkeypatch.setitem(peps_envs.registry._TASKS, "line", lambda: task)
    monkeypatch.setattr(pictures, "draw", lambda rows, folder: [])
    monkeypatch.setattr(workers, "SILENCE", 1.0)
    monkeypatch.setattr(workers, "BEAT", 0.1)
    run = lambda coordinator: coordinator.replace(":", "-")  # the same for all, and another one every time
    came = lambda place, wait: workers.Team(place.index, place.count, run(place.coordinator), place.count)
    monkeypatch.setattr(meeting, "join", came)


PORTS = itertools.count(1)


def member(index: int, count: int, port: int = 0) -> list[str]:
    return ["--coordinator", f"here:{port}", "--processes", str(count), "--process", str(index)]


def run_together(folder: Path, indices: list[int], count: int, *flags: str) -> dict[int, int]:
    """The exit codes of those processes."""
    codes, port = {}, next(PORTS)
    act = lambda index: codes.update({index: call(*flags, *member(index, count, port), "--out", folder)})
    threads = [threading.Thread(target=act, args=(index,)) for index in indices]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    return codes


def test_processes_divide_the_runs(team, tmp_path):
    assert call(*LINE, "--out", tmp_path / "one") == 0
    assert run_together(tmp_path / "three", [0, 1, 2], 3, *LINE) == {0: 0, 1: 0, 2: 0}
    assert contents(tmp_path / "three") == contents(tmp_path / "one")
    manifest = json.loads((tmp_path / "three" / results.MANIFEST).read_text(encoding="utf-8"))
    assert manifest["status"] == "complete"
    assert manifest["env_steps"] == 8 * 160


def test_a_process_that_never_comes_is_said_and_the_others_are_kept(team, tmp_path, capsys):
    folder = tmp_path / "out"
    assert run_together(folder, [0, 2], 3, *LINE) == {0: 1, 2: 0}
    error = capsys.readouterr().err
    assert "process 1 didn't finish: no sign of life" in error
    assert f"6 of 8 rows are finished and kept in {folder}; continue with: " in error
    with open(folder / results.TABLE, newline="", encoding="utf-8") as file:
        assert len(list(csv.DictReader(file))) == 6
    assert json.loads((folder / results.MANIFEST).read_text(encoding="utf-8"))["status"] == "interrupted"
    assert run_together(folder, [0, 1], 2, "--resume") == {0: 0, 1: 0}, "by other processes, too"
    assert call(*LINE, "--out", tmp_path / "one") == 0
    assert contents(folder) == contents(tmp_path / "one")


def test_a_process_that_fails_says_why_to_all(team, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(threading, "excepthook", lambda arguments: None)
    compiled = batches.program

    def refuse(*arguments):
        if threading.current_thread() in failing:
            raise MemoryError("no room for this")
        return compiled(*arguments)

    monkeypatch.setattr(batches, "program", refuse)
    folder, codes = tmp_path / "out", {}
    act = lambda index: codes.update({index: call(*LINE, *member(index, 2), "--out", folder)})
    threads = [threading.Thread(target=act, args=(index,)) for index in (0, 1)]
    failing = {threads[1]}
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert codes == {0: 1}
    assert "process 1 didn't finish: failed: MemoryError: no room for this" in capsys.readouterr().err
    assert len(list((folder / results.RUNS).iterdir())) == 4


def test_process_0_that_fails_is_said_by_the_others(team, tmp_path, capsys, monkeypatch):
    compiled = batches.program

    def refuse(*arguments):
        if threading.current_thread() is threads[0]:
            raise MemoryError("no room for this")
        return compiled(*arguments)

    monkeypatch.setattr(batches, "program", refuse)
    monkeypatch.setattr(threading, "excepthook", lambda arguments: None)
    folder, codes = tmp_path / "out", {}
    act = lambda index: codes.update({index: call(*LINE, *member(index, 2), "--out", folder)})
    threads = [threading.Thread(target=act, args=(index,)) for index in (0, 1)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert codes == {1: 1}
    error = capsys.readouterr().err
    assert (
        "process 1: its share is done and kept, but process 0, which makes the tables, doesn't go on (failed: " in error
    )
    assert f"continue with: {command.PROG} --resume --out {folder}\n" in error


def test_without_process_0_the_others_are_kept(team, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(waiting, "EVERY", 0.4)
    assert run_together(tmp_path / "out", [1], 2, *LINE, "--wait", "0.5") == {1: 2}
    error = capsys.readouterr().err
    reminder, complaint = error.splitlines()
    assert reminder.startswith("process 1 waits for process 0 to share out the batches in ")
    assert "process 0 hasn't shared out the batches in 0.5 s" in complaint


def test_who_comes_when_process_0_has_done_all_is_done_too(team, tmp_path, monkeypatch, capsys):
    folder = tmp_path / "out"
    assert run_together(folder, [0], 2, *LINE) == {0: 1}, "half of it"
    assert call("--resume", "--out", folder) == 0
    manifest = folder / results.MANIFEST
    complete = manifest.read_text(encoding="utf-8")
    manifest.write_text(complete.replace('"complete"', '"running"'), encoding="utf-8")

    def came(place, wait):
        manifest.write_text(complete, encoding="utf-8")
        return workers.Team(place.index, place.count, "these", place.count)

    monkeypatch.setattr(meeting, "join", came)
    assert call("--resume", *member(1, 2), "--out", folder, "--wait", "5") == 0
    assert "process 1: its share is done" in capsys.readouterr().err


def free_port() -> int:
    with socket.socket() as door:
        door.bind(("localhost", 0))
        return door.getsockname()[1]


@pytest.mark.slow
def test_two_processes_have_the_numbers_of_one(tmp_path):
    one_device = {"XLA_FLAGS": os.environ["XLA_FLAGS"].replace("device_count=2", "device_count=1")}  # the same program
    cache = {"JAX_COMPILATION_CACHE_DIR": str(tmp_path / "compiled"), "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0"}
    flags = ["--env", "nav-d1", "--method", "sac", "--seeds", "8", *SIZES]

    def start(*more: str) -> subprocess.Popen:
        command = [sys.executable, "-m", "peps_jax.sweep", *flags, *more]
        environment = os.environ | cache | one_device
        return subprocess.Popen(
            command, env=environment, encoding="utf-8", stdout=subprocess.PIPE, stderr=subprocess.PIPE
        )

    coordinator = f"localhost:{free_port()}"
    together = ("--out", str(tmp_path / "two"), "--coordinator", coordinator, "--processes", "2")
    pair = [start(*together, "--process", str(index)) for index in (0, 1)]
    told = [process.communicate(timeout=600) for process in pair]
    assert [process.returncode for process in pair] == [0, 0], told
    assert "process 1: its share is done" in told[1][1]
    one = start("--out", str(tmp_path / "one"))
    _, error = one.communicate(timeout=600)
    assert one.returncode == 0, error
    assert contents(tmp_path / "two") == contents(tmp_path / "one")
    with open(tmp_path / "two" / results.TABLE, newline="", encoding="utf-8") as file:
        assert [int(row["seed"]) for row in csv.DictReader(file)] == list(range(8)), "every run once"


def test_life_and_death_are_told_apart(tmp_path, monkeypatch):
    monkeypatch.setattr(workers, "SILENCE", 0.3)
    monkeypatch.setattr(workers, "BEAT", 0.05)
    (tmp_path / "progress").mkdir()
    teams = [workers.Team(index, 4, "now") for index in range(4)]
    earlier = workers.Life(tmp_path, teams[1]._replace(run="earlier"))
    with earlier:
        pass
    done, alive = workers.Life(tmp_path, teams[2]), workers.Life(tmp_path, teams[3])
    done.__enter__()
    alive.__enter__()
    others = workers.Others(tmp_path, teams[0])
    assert others.ends() == {}
    done.__exit__(None, None, None)
    end = time.monotonic() + 0.6
    while time.monotonic() < end:
        ends = others.ends()
        time.sleep(0.02)
    assert ends == {1: "no sign of life for 0 s", 2: workers.DONE}
    alive.__exit__(ValueError, ValueError("because"), None)
    assert others.ends()[3] == "failed: ValueError: because"


def test_who_does_not_go_on_is_said_meanwhile(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(workers, "SILENCE", 0.4)
    monkeypatch.setattr(workers, "BEAT", 0.05)
    (tmp_path / "progress").mkdir()
    teams = [workers.Team(index, 4, "now") for index in range(4)]
    first, second, third = (workers.Life(tmp_path, team) for team in teams[:3])
    for life in (first, second, third):
        life.__enter__()
    time.sleep(0.8)  # process 3 doesn't come
    third.__exit__(None, None, None)
    first.__exit__(files.NotWrittenError, files.NotWrittenError("no room"), None)
    time.sleep(0.3)
    second.__exit__(None, None, None)
    assert capsys.readouterr().err.splitlines() == [
        "process 0: process 3 doesn't go on (no sign of life for 0 s); the others go on, and --resume does what is left",
        "process 1: process 0 doesn't go on (failed: no room); this one goes on",
    ]
