"""A sweep that comes back late, or second, to its folder writes nothing there, and says so in one line."""

import os
import signal
import threading
import time

import jax.numpy as jnp
import pytest
from commands import contents, everything
from sweeps import LINE, SIZES, call, start, with_line

import peps_jax
from peps_jax.execution import program
from peps_jax.storage import files
from peps_jax.storage.ownership import OWNER, Owner, owners
from peps_jax.sweep import command, journal, meeting, pictures, results, underway, workers

# a process that loses its folder inside one of Orbax's calls takes its threads with it; here they come back
pytestmark = pytest.mark.filterwarnings("ignore:(?s).*Event loop is closed:pytest.PytestUnraisableExceptionWarning")

OTHER = [*LINE, "--seed", "10", "--seeds", "2", "--overwrite"]
LOST = "this run has lost the folder"


@pytest.fixture
def line_task(line, monkeypatch):
    with_line(monkeypatch, line)


def at(patch, place: object, name: str, number: int, act) -> None:
    """The process sleeps at its `number`-th call of that, and meanwhile `act` happens."""
    called, left = getattr(place, name), [number]

    def sleep_first(*arguments, **named):
        left[0] -= 1
        if left[0] == 0:
            act()
        return called(*arguments, **named)

    patch.setattr(place, name, sleep_first)


MOMENTS = {
    "in its first batch": (underway.Keeper, "advanced", 2),
    "as it makes a checkpoint": (files, "write_folder", 2),
    "as it keeps a batch": (journal.Journal, "commit", 1),
    "as it begins another batch": (underway.Keeper, "start", 2),
    "as it draws what is finished": (pictures, "draw", 1),
    "as it draws all": (pictures, "draw", 2),
    "as it closes": (underway.Sweep, "close", 1),
    "as it removes its progress": (journal, "close", 1),
}


CASES = [(moment, by, "is terminated") for moment in MOMENTS for by in ("--resume", "--overwrite")]
CASES += [(next(iter(MOMENTS)), "--resume", wakes) for wakes in ("goes on", "is interrupted")]
CASES.remove(("as it removes its progress", "--resume", "is terminated"))  # it is complete, and the other one clears up


@pytest.mark.parametrize(("moment", "by", "wakes"), CASES)
def test_a_sweep_that_comes_back_late_spoils_nothing(moment, by, wakes, line_task, tmp_path, capsys, monkeypatch):
    folder, after = tmp_path / "out", {}

    def take_over():
        assert not after, "the other sweep comes by there, too"
        after["begun"] = True
        assert call(*(["--resume"] if by == "--resume" else OTHER), "--out", folder) == 0
        after.update(everything(folder))
        capsys.readouterr()
        if wakes == "is terminated":
            os.kill(os.getpid(), signal.SIGTERM)
        elif wakes == "is interrupted":
            raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        at(patch, *MOMENTS[moment], take_over)
        assert call(*LINE, "--out", folder) == 2
    printed = capsys.readouterr()
    assert printed.err.count("\n") == 1, printed.err
    assert printed.err.startswith(f"{command.PROG}: error: {LOST}")
    assert not printed.out
    assert after.pop("begun")
    assert everything(folder) == after
    assert peps_jax.load(folder, 0).act(jnp.zeros(1)).shape == (1,)
    assert call("--resume", "--out", folder) == 0
    assert "nothing to continue" in capsys.readouterr().out


def test_two_sweeps_that_are_started_at_once(line_task, tmp_path, capsys, monkeypatch):
    """Both have found the folder empty before either takes it."""
    alone, together, codes = tmp_path / "alone", tmp_path / "together", []
    assert call(*LINE, "--out", alone) == 0
    capsys.readouterr()
    barrier, claim = threading.Barrier(2), Owner.claim

    def claim_together(self, *arguments):
        barrier.wait()
        return claim(self, *arguments)

    with monkeypatch.context() as patch:
        patch.setattr(Owner, "claim", claim_together)
        threads = [threading.Thread(target=lambda: codes.append(call(*LINE, "--out", together))) for _ in range(2)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    assert sorted(codes) == [0, 2]
    assert capsys.readouterr().err.count("error: ") == 1
    assert contents(together) == contents(alone)
    assert not (together / OWNER).exists()


def test_who_begins_when_another_has_finished_meanwhile_is_refused(line_task, tmp_path, capsys, monkeypatch):
    with monkeypatch.context() as patch:
        at(patch, Owner, "claim", 1, lambda: call(*LINE, "--out", tmp_path))
        assert call(*LINE, "--resume", "--out", tmp_path) == 2
    assert "holds another run's results" in capsys.readouterr().err
    assert results.is_complete(tmp_path)
    assert not (tmp_path / OWNER).exists()


class KilledError(BaseException):
    """As if the process were gone."""


def test_who_was_killed_at_once_is_in_nobodys_way(line_task, tmp_path, capsys, monkeypatch):
    def die(folder):
        raise KilledError

    for flag in ("--resume", "--overwrite"):
        with monkeypatch.context() as patch:
            patch.setattr(journal, "clear", die)
            with pytest.raises(KilledError):
                call(*LINE, "--out", tmp_path / flag)
        assert [path.name for path in (tmp_path / flag).iterdir()] == [OWNER]
        assert call(*LINE, "--out", tmp_path / flag) == 2
        assert "belongs to another run" in capsys.readouterr().err
        assert call(*LINE, flag, "--out", tmp_path / flag) == 0
        assert not (tmp_path / flag / OWNER).exists()


def test_a_sweep_that_stopped_is_copied_with_its_owner_and_continued(line_task, tmp_path, monkeypatch):
    def die(*arguments):
        raise KilledError

    with monkeypatch.context() as patch:
        patch.setattr(underway.Keeper, "start", die)
        with pytest.raises(KilledError):
            call(*LINE, "--out", tmp_path / "out")
    assert len(owners(tmp_path / "out")) == 1
    (tmp_path / "out" / OWNER / "another").mkdir()  # as after a copy into a folder that was somebody's
    os.rename(tmp_path / "out", tmp_path / "moved")
    assert call("--resume", "--out", tmp_path / "moved") == 0
    assert not (tmp_path / "moved" / OWNER).exists()


def test_processes_of_one_sweep_lose_their_folder_together(line_task, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(workers, "BEAT", 0.05)
    came = lambda place, wait: workers.Team(place.index, place.count, "these", place.count)
    monkeypatch.setattr(meeting, "join", came)
    folder, after, advanced, door = tmp_path / "out", {}, underway.Keeper.advanced, threading.Barrier(2)

    def take_over(self, *arguments):
        if self._sweep.owner.run != "these":
            return advanced(self, *arguments)
        door.wait()
        if self._sweep._team.leads:
            assert call("--resume", "--out", folder) == 0
            time.sleep(0.2)  # for a sign of life, which must not come
            after.update(everything(folder))
        door.wait()
        return advanced(self, *arguments)

    monkeypatch.setattr(underway.Keeper, "advanced", take_over)
    codes = {}
    act = lambda index: codes.update({index: call(*LINE, *member(index, 2), "--out", folder)})
    threads = [threading.Thread(target=act, args=(index,)) for index in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert codes == {0: 2, 1: 2}
    assert capsys.readouterr().err.count(LOST) == 2
    assert everything(folder) == after


def member(index: int, count: int) -> list[str]:
    return ["--coordinator", "here:1", "--processes", str(count), "--process", str(index)]


@pytest.mark.parametrize(("failing", "code"), [(4, 1), (2, 0)])
def test_a_sweep_of_which_every_run_failed_says_so_by_its_exit_code(
    failing, code, line_task, tmp_path, monkeypatch, capsys
):
    left, finite = [failing], program._finite

    def fail(tree):
        left[0] -= 1
        return left[0] < 0 and finite(tree)

    monkeypatch.setattr(program, "_finite", fail)
    assert call(*LINE, "--out", tmp_path) == code
    printed = capsys.readouterr().out
    assert f"{failing} of 4 rows failed" in printed
    assert ("go on with" in printed) == (code == 0)
    assert results.is_complete(tmp_path)
    assert call("--resume", "--out", tmp_path) == code
    assert ("all of them failed" in capsys.readouterr().out) == (code == 1)


# --- processes ------------------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("by", ["--resume", "--overwrite"])
def test_a_process_that_is_suspended_and_wakes_up_late(by, compiled, tmp_path):
    flags = ["--env", "nav-d1", "--method", "sac", "--seeds", "2", "--total-steps", "1200", *SIZES]
    folder = tmp_path / "out"
    late = start(compiled, *flags, "--out", folder)
    while late.poll() is None and not list(folder.glob("progress/batch-00000/rounds-*")):
        time.sleep(0.002)
    os.kill(late.pid, signal.SIGSTOP)
    other = start(compiled, *(["--resume"] if by == "--resume" else [*flags, by, "--seed", "7"]), "--out", folder)
    _, error = other.communicate(timeout=600)
    assert other.returncode == 0, error
    after = everything(folder)
    assert not (folder / OWNER).exists()
    os.kill(late.pid, signal.SIGTERM)
    os.kill(late.pid, signal.SIGCONT)
    printed, error = late.communicate(timeout=600)
    assert late.returncode == 2, error
    assert LOST in error.splitlines()[-1]
    assert error.count("error: ") == 1
    assert "Traceback" not in error
    assert not printed
    assert everything(folder) == after
    assert peps_jax.load(folder, 0).curves
