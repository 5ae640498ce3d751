"""The processes of a sweep come together; who waits says for whom, and ends in one line when the time is up."""

import json
import os
import socket
import subprocess
import sys
import threading
import time
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

import jax
import pytest
from commands import exit_code

from peps_jax.execution import machine, waiting
from peps_jax.sweep import command, meeting
from peps_jax.sweep.meeting import Place

ROOT = Path(__file__).parents[2]


@pytest.fixture
def coordinator():
    """An address at which nobody listens."""
    with socket.socket() as door:
        door.bind(("localhost", 0))
        return f"localhost:{door.getsockname()[1]}"


@pytest.fixture
def at_once(monkeypatch):
    """Reminders and further attempts come soon."""
    monkeypatch.setattr(waiting, "EVERY", 0.2)
    monkeypatch.setattr(meeting, "PAUSE", 0.05)


def start(pool: ThreadPoolExecutor, coordinator: str, index: int, count: int = 3, wait: float = 30.0) -> Future:
    return pool.submit(meeting.join, Place(coordinator, count, index), wait)


def stranger(coordinator: str, said: bytes) -> socket.socket:
    """Somebody who calls process 0 and says that, as soon as it listens."""
    host, _, port = coordinator.rpartition(":")
    end = time.monotonic() + 30
    while True:
        try:
            line = socket.create_connection((host, int(port)))
            line.sendall(said)
            return line
        except OSError:
            assert time.monotonic() < end
            time.sleep(0.02)


def test_all_have_the_same_run(coordinator, at_once):
    with ThreadPoolExecutor(3) as pool:
        teams = [one.result() for one in [start(pool, coordinator, index) for index in (2, 1, 0)]]
    assert [team.index for team in teams] == [2, 1, 0]
    assert len({team.run for team in teams}) == 1
    assert len(teams[0].run) == 16
    assert {(team.count, team.neighbours) for team in teams} == {(3, 3)}


def test_one_process_is_a_team(coordinator):
    assert meeting.join(Place(coordinator, 1, 0)).count == 1


def test_who_leaves_is_missing_until_it_comes_again(coordinator, at_once, capsys):
    with ThreadPoolExecutor(3) as pool:
        first = start(pool, coordinator, 0)
        with stranger(coordinator, b'{"process": 1, "processes": 3, "host": "far away"}\n') as early:
            assert json.loads(early.recv(1000)) == {"missing": "process 2"}
        second = start(pool, coordinator, 2)
        time.sleep(0.5)
        assert not first.done()
        teams = [one.result() for one in (first, start(pool, coordinator, 1), second)]
    assert [team.neighbours for team in teams] == [3, 3, 3]
    assert f"process 2 waits: process 1 didn't come to {coordinator} yet" in capsys.readouterr().err


@pytest.mark.parametrize("said", [b"GET / HTTP/1.1\r\n", b"\xff\n", b"[]\n", b'{"process": "one"}\n', b"x" * 10_000])
def test_a_stranger_disturbs_nobody(said, coordinator, at_once):
    with ThreadPoolExecutor(3) as pool:
        first = start(pool, coordinator, 0)
        with stranger(coordinator, said):
            others = [start(pool, coordinator, index) for index in (1, 2)]
            assert len({one.result().run for one in (first, *others)}) == 1


def test_who_does_not_come_is_said_by_all(coordinator, at_once, capsys):
    with ThreadPoolExecutor(3) as pool:
        first, second = (start(pool, coordinator, index, 5, 1.0 + index) for index in (0, 1))
        with pytest.raises(ValueError, match=f"processes 2, 3 and 4 of 5 didn't come to {coordinator} in 1 s; see"):
            first.result()
        with pytest.raises(ValueError, match="process 0 refused process 1: processes 2, 3 and 4 of 5 didn't come"):
            second.result()
    error = capsys.readouterr().err
    assert f"process 0 waits at {coordinator} for processes 2, 3 and 4, 0 s so far" in error
    assert f"process 1 waits: processes 2, 3 and 4 didn't come to {coordinator} yet, 0 s so far" in error


def test_an_address_where_nobody_listens(coordinator, at_once, capsys):
    with pytest.raises(ValueError, match=f"gave up after 0.5 s: process 0 isn't reached at {coordinator} .*refused"):
        meeting.join(Place(coordinator, 2, 1), 0.5)
    reminders = capsys.readouterr().err.splitlines()
    assert len(reminders) == 2
    assert all(line.startswith(f"process 1 waits: process 0 isn't reached at {coordinator} (") for line in reminders)


def test_an_address_that_says_nothing(coordinator, at_once):
    with socket.create_server(("localhost", int(coordinator.rpartition(":")[2]))):
        began = time.monotonic()
        with pytest.raises(ValueError, match=f"gave up after 0.5 s: not all have come to {coordinator}"):
            meeting.join(Place(coordinator, 2, 1), 0.5)
    assert time.monotonic() - began < 5


def test_an_address_of_something_else(coordinator):
    def answer():
        line, _ = door.accept()
        with line:
            line.sendall(b"SSH-2.0-OpenSSH_9.2\r\n")
            line.recv(1000)

    with socket.create_server(("localhost", int(coordinator.rpartition(":")[2]))) as door:
        other = threading.Thread(target=answer)
        other.start()
        with pytest.raises(ValueError, match=r"is no process 0 of a sweep, but says b'SSH-2.0"):
            meeting.join(Place(coordinator, 2, 1), 30)
        other.join()


def test_a_port_that_is_taken(coordinator):
    port = int(coordinator.rpartition(":")[2])
    with (
        socket.create_server(("", port)),
        pytest.raises(ValueError, match=f"process 0 can't listen on port {port} of .*: Address already in use"),
    ):
        meeting.join(Place(coordinator, 2, 0), 1)


def test_another_number_of_processes_is_refused(coordinator, at_once):
    with ThreadPoolExecutor(3) as pool:
        others = [start(pool, coordinator, index) for index in (0, 1)]
        with pytest.raises(
            ValueError, match=r"refused process 2: it says that there are 4 processes, process 0 that .* 3"
        ):
            start(pool, coordinator, 2, 4).result()
        assert len({one.result().run for one in (*others, start(pool, coordinator, 2))}) == 1


def test_a_twin_is_refused(coordinator, at_once):
    with ThreadPoolExecutor(3) as pool:
        first = start(pool, coordinator, 0)
        with stranger(coordinator, b'{"process": 2, "processes": 3, "host": ""}\n') as twin:
            assert json.loads(twin.recv(1000)) == {"missing": "process 1"}
            with pytest.raises(ValueError, match="refused process 2: another process 2 is there already"):
                start(pool, coordinator, 2).result()
        others = [start(pool, coordinator, index) for index in (1, 2)]
        assert len({one.result().run for one in (first, *others)}) == 1


# --- a cluster's settings -------------------------------------------------------------------------------------------------


def test_slurm_tells_where_and_which(monkeypatch):
    settings = {"SLURM_JOB_ID": "71234", "SLURM_STEP_NODELIST": "node[3-4]", "SLURM_NTASKS": "8"}
    for name, value in {**settings, "SLURM_PROCID": "5", "SLURM_LOCALID": "1"}.items():
        monkeypatch.setenv(name, value)
    place = meeting.find()
    assert place == Place(place.coordinator, 8, 5, "1")
    assert place.host == "node3"
    assert place.port > 1023


def test_no_cluster_is_said(tmp_path, capsys):
    assert exit_code(command.main, "--distributed", "--out", tmp_path / "out") == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert (
        "no cluster tells it the coordinator: without a cluster that JAX knows, give every process --coordinator"
        in error
    )


def test_a_cluster_whose_settings_make_no_sense_is_said(monkeypatch):
    for name in ("SLURM_JOB_ID", "SLURM_STEP_NODELIST", "SLURM_NTASKS", "SLURM_PROCID", "SLURM_LOCALID"):
        monkeypatch.setenv(name, "many")
    with pytest.raises(
        ValueError, match=r"the cluster's settings can't be read: invalid literal .*--coordinator HOST:PORT"
    ):
        meeting.find()


def test_a_process_has_its_own_accelerators_before_jax_meets_any(coordinator, monkeypatch, tmp_path):
    seen = []

    def meet():
        seen.append(jax.config.read("jax_cuda_visible_devices"))
        raise ValueError("seen enough")

    monkeypatch.setenv("JAX_LOCAL_DEVICE_IDS", "3")
    monkeypatch.setattr(machine, "meet_devices", meet)
    try:
        flags = ("--coordinator", coordinator, "--processes", 2, "--process", 1, "--out", tmp_path / "out")
        assert exit_code(command.main, *flags) == 2
    finally:
        jax.config.update("jax_cuda_visible_devices", "all")
        jax.config.update("jax_rocm_visible_devices", "all")
    assert seen == ["3"]


@pytest.mark.parametrize("index", [0, 1])
def test_a_command_that_waits_in_vain_ends_in_one_line(index, coordinator, tmp_path):
    words = [sys.executable, "-m", "peps_jax.sweep", "--out", tmp_path / "out", "--wait", "0.5"]
    words += ["--coordinator", coordinator, "--processes", "2", "--process", str(index)]
    done = subprocess.run(
        list(map(str, words)), capture_output=True, encoding="utf-8", cwd=ROOT, env=os.environ, timeout=60, check=False
    )
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    assert done.stderr.startswith("python -m peps_jax.sweep: error: process 1 ")
    assert coordinator in done.stderr
    assert "0.5 s" in done.stderr
    assert not (tmp_path / "out").exists()
