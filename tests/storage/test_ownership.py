"""A folder is one run's at a time: who comes back late, or second, writes nothing, and says so in one line."""

import ast
import itertools
import os
import signal
import subprocess
import sys
import threading
import time
import types
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from commands import contents, exit_code

import peps_envs
import peps_jax
from peps_jax.execution import batches, compilation_cache, program
from peps_jax.reproduce import __main__ as reproduce
from peps_jax.reproduce.store import Store
from peps_jax.storage import files
from peps_jax.storage.ownership import OWNER, Owner, OwnershipLostError, owners
from peps_jax.sweep import command, journal, meeting, pictures, results, underway, workers

# a process that loses its folder inside one of Orbax's calls takes its threads with it; here they come back
pytestmark = pytest.mark.filterwarnings("ignore:(?s).*Event loop is closed:pytest.PytestUnraisableExceptionWarning")

SIZES = [
    *("--num-envs", "4", "--rollout-length", "10", "--warmup-steps", "40", "--batch-size", "16"),
    *("--updates-per-step", "0.1", "--hidden-sizes", "8", "--model-hidden-sizes", "8", "--ensemble-size", "3"),
    *("--episodes", "4", "--checkpoint-every", "0"),
]
LINE = ["--env", "line", "--method", "sac", "--seeds", "4", "--total-steps", "160", *SIZES]  # two batches of two runs
OTHER = [*LINE, "--seed", "10", "--seeds", "2", "--overwrite"]
LOST = "this run has lost the folder"


def everything(folder: Path) -> dict[str, bytes | None]:
    """All that lies in a folder, by its path inside; folders are None."""
    found = sorted(folder.rglob("*"))
    return {str(path.relative_to(folder)): path.read_bytes() if path.is_file() else None for path in found}


def unasked() -> None:
    """A folder may hold anything."""


def owner_of(folder: Path, over: bool = True) -> Owner:
    owner = Owner(folder)
    owner.claim(unasked, over)
    return owner


# --- files ----------------------------------------------------------------------------------------------------------------

ACTS = {
    "a file": lambda folder: files.write_whole(folder / "file", b"late"),
    "a new file": lambda folder: files.write_whole(folder / "inner" / "new", b"late"),
    "a file that something else makes": lambda folder: files.write_with(
        folder / "file", lambda path: path.write_text("late", encoding="utf-8")
    ),
    "a folder": lambda folder: files.write_folder(folder / "inner", lambda inner: (inner / "late").touch()),
    "a new folder": lambda folder: files.make_folder(folder / "new" / "newer"),
    "the removal of a file": lambda folder: files.remove(folder / "file"),
    "the removal of a folder": lambda folder: files.remove(folder / "inner"),
    "the removal of what is gone": lambda folder: files.remove(folder / "gone"),
    "clearing up": lambda folder: (folder / f"{files.TEMPORARY}x").exists() and files.remove_unfinished(folder),
}


def filled(folder: Path) -> Path:
    """A folder with a file, a folder with another, and what a killed process left; it is somebody's."""
    owner = owner_of(folder, over=False)
    with owner.writing():
        files.write_whole(folder / "file", b"winner's")
        files.make_folder(folder / "inner")
        files.write_whole(folder / "inner" / "file", b"winner's")
    (folder / f"{files.TEMPORARY}x").mkdir()
    return folder


@pytest.fixture
def folder(tmp_path):
    return filled(tmp_path / "deep" / "out")


@pytest.mark.parametrize("act", ACTS.values(), ids=ACTS)
def test_the_owner_may_and_who_was_it_may_not(act, folder):
    first, second = owner_of(folder), owner_of(folder)
    before = everything(folder)
    with first.writing(), pytest.raises(OwnershipLostError, match=LOST):
        act(folder)
    assert everything(folder) == before
    with second.writing():
        act(folder)
    second.check()


@pytest.mark.parametrize("act", ACTS.values(), ids=ACTS)
def test_no_moment_lies_between_check_and_act(act, tmp_path):
    """Suspended before any of its calls to the system, until another process has taken the folder."""
    lost = []
    for moment in itertools.count():
        folder, left, after = filled(tmp_path / str(moment)), [moment], {}
        first = owner_of(folder)

        def suspend(event, folder=folder, left=left, after=after):
            left[0] -= event in CHANGES and not after
            if left[0] < 0 and not after:
                after["second"] = None  # what it does itself isn't heard
                after["second"] = owner_of(folder)
                after["everything"] = everything(folder)

        HOOK.hear = suspend
        try:
            with first.writing():
                act(folder)
        except OwnershipLostError:
            lost.append(moment)
        finally:
            HOOK.hear = None
        if not after:
            break
        assert everything(folder) == after["everything"]
        after["second"].check()
    assert moment >= 3
    assert lost == list(range(len(lost))), "whoever wakes up later has done it before"
    assert len(lost) >= 2


CHANGES = ("open", "os.rename", "os.mkdir", "os.remove", "os.rmdir", "os.scandir", "shutil.rmtree")


class Hook:
    """Hears what Python asks of the system; an audit hook can't be removed, so that this one is there once."""

    hear = None

    def __init__(self):
        sys.addaudithook(lambda event, arguments: self.hear and self.hear(event))


HOOK = Hook()


@pytest.mark.parametrize("over", [False, True])
def test_of_several_claims_at_once_one_owner_remains(over, tmp_path):
    for attempt in range(20):
        folder, made = tmp_path / str(attempt), []
        if over:
            owner_of(folder)
        barrier = threading.Barrier(4)

        def claim(folder=folder, made=made, barrier=barrier):
            owner = Owner(folder)
            barrier.wait()
            try:
                owner.claim(unasked, over)
            except ValueError:
                return
            made.append(owner)

        threads = [threading.Thread(target=claim) for _ in range(4)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        present = [owner for owner in made if owners(folder) == (owner.run,)]
        assert len(present) == 1
        assert len(made) == 1 or over, "with --overwrite a later one takes it from an earlier one"
        present[0].release()
        assert not everything(folder)


def test_a_claim_that_is_refused_takes_nothing_from_anybody(folder):
    owner, before = owner_of(folder), everything(folder)

    def refuse():
        raise ValueError("not as it should be")

    with pytest.raises(ValueError, match="not as it should be"):
        Owner(folder).claim(refuse, over=True)
    with pytest.raises(ValueError, match=r"belongs to another run.*--overwrite"):
        Owner(folder).claim(unasked, over=False)
    assert everything(folder) == before
    owner.check()
    owner.release()
    answers = iter([None, ValueError("changed meanwhile")])

    def change():
        if answer := next(answers):
            raise answer

    with pytest.raises(ValueError, match="changed meanwhile"):
        Owner(folder).claim(change, over=False)
    assert owners(folder) == ()


def test_whatever_fails_in_a_lost_folder_fails_for_that(folder):
    owner = owner_of(folder)
    with pytest.raises(FileNotFoundError), owner.writing():
        (folder / "gone").read_bytes()
    owner_of(folder)
    with pytest.raises(OwnershipLostError), owner.writing():
        (folder / "gone").read_bytes()


def test_commands_write_through_files_alone():
    """A picture that matplotlib put into a folder by itself would ask nobody whose it is."""
    past = {"write_text", "write_bytes", "savefig", "unlink", "rmtree", "mkdir", "rmdir", "animate", "film", "dump"}
    package = Path(peps_jax.__file__).parent
    for path in [*(package / "sweep").rglob("*.py"), *(package / "reproduce").rglob("*.py")]:
        tree = ast.parse(path.read_text(encoding="utf-8"))
        named = lambda call: call.func.attr if isinstance(call.func, ast.Attribute) else ""
        calls = [node for node in ast.walk(tree) if isinstance(node, ast.Call)]
        inside = {inner for call in calls if named(call) == "write_with" for inner in ast.walk(call)}
        assert not [named(call) for call in calls if named(call) in past and call not in inside], path


# --- sweeps ---------------------------------------------------------------------------------------------------------------


@pytest.fixture
def line_task(line, monkeypatch):
    """The line as an environment that command lines know, in batches of two runs, and a moment's drawing."""
    task = peps_envs.Task(line.env, line.params, {"noisy": line.belief, "true": line.params})
    monkeypatch.setitem(peps_envs.registry._TASKS, "line", lambda: task)
    monkeypatch.setattr(batches, "RUNS_PER_DEVICE", 1)
    monkeypatch.setattr(pictures, "draw", lambda rows, folder: [])


def call(*arguments: object) -> int:
    return exit_code(command.main, *arguments)


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
    "as it draws": (pictures, "draw", 1),
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


@pytest.fixture(scope="module")
def compiled(tmp_path_factory):
    """The environment of processes that share what they compile."""
    cache = str(tmp_path_factory.mktemp("compiled"))
    return os.environ | {
        compilation_cache.VARIABLE: cache,
        "JAX_COMPILATION_CACHE_DIR": cache,
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
        "JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES": "-1",
    }


def start(environment, *arguments: object) -> subprocess.Popen:
    words = [sys.executable, "-m", "peps_jax.sweep", *map(str, arguments)]
    return subprocess.Popen(words, env=environment, encoding="utf-8", stdout=subprocess.PIPE, stderr=subprocess.PIPE)


@pytest.mark.slow
@pytest.mark.parametrize("by", ["--resume", "--overwrite"])
def test_a_process_that_is_suspended_and_wakes_up_late(by, compiled, tmp_path):
    flags = ["--env", "nav-d1", "--method", "sac", "--seeds", "2", "--total-steps", "4000", *SIZES]
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


# --- reproduction ---------------------------------------------------------------------------------------------------------


def test_a_store_keeps_nothing_in_a_folder_that_it_has_lost(tmp_path, tiny):
    first, second = Store(tmp_path, tiny, 4, seeds=2), Store(tmp_path, tiny, 4, seeds=3)
    first.open()
    second.open()
    before = everything(tmp_path)
    with pytest.raises(OwnershipLostError):
        first.save("run", {}, {"routes": np.zeros((3, 2, 2))})
    with pytest.raises(OwnershipLostError), first.writing():
        files.write_whole(tmp_path / "table1.md", b"late")
    first.close()
    assert everything(tmp_path) == before
    second.close()
    assert not (tmp_path / OWNER).exists()


def test_a_reproduction_that_comes_back_late_spoils_nothing(tmp_path, tiny, capsys, monkeypatch):
    after = {}

    def write(made, folder):
        if not after:
            after["begun"] = None
            assert reproduce.main(["table1", "--seeds", "3", "--out", str(folder)], tiny) == 0
            after.clear()
            after.update(everything(folder))
            capsys.readouterr()
            seeds = b"late"
        else:
            seeds = str(made.seeds).encode()
        files.write_whole(folder / "table1.md", seeds)
        return [folder / "table1.md"]

    table = types.SimpleNamespace(ABOUT="", needs=lambda made: [], write=write)
    monkeypatch.setitem(reproduce.RESULTS, "table1", table)
    assert reproduce.main(["table1", "--seeds", "2", "--out", str(tmp_path)], tiny) == 2
    printed = capsys.readouterr()
    assert printed.err.startswith(f"{reproduce.PROG}: error: {LOST}")
    assert printed.err.count("\n") == 1
    assert not printed.out
    assert everything(tmp_path) == after
    assert after["table1.md"] == b"3"
