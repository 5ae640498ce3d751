"""A sweep that is stopped, killed or starved anywhere and continued has the files of one that wasn't, bit by bit."""

import errno
import json
import os
import random
import shutil
import signal
import sys
import time
from pathlib import Path

import jax
import numpy as np
import pytest
from commands import contents
from sweeps import LINE, SIZES, call, start, with_line

from peps_jax.execution import checkpoints, program
from peps_jax.storage import files
from peps_jax.sweep import command, journal, results, underway

# a real death takes the threads of Orbax with it; here they come back to a loop that is no more
pytestmark = pytest.mark.filterwarnings("ignore:(?s).*Event loop is closed:pytest.PytestUnraisableExceptionWarning")

PREFIX = "python -m peps_jax.sweep: error: "
KILLS, CORRUPTIONS = 50, 24


class KilledError(BaseException):
    """As if the process were gone: nothing catches it, and nothing is written any more."""


class Death:
    """Ends a sweep at its n-th access to its folder, or end of a chunk; then refuses every access."""

    def __init__(self):
        self.folder, self.left = None, 0
        sys.addaudithook(self._hear)  # it can't be removed: it is deaf without a folder

    def arm(self, folder: Path, after: int) -> None:
        self.folder, self.left = str(folder), after

    def disarm(self) -> None:
        self.folder = None

    def tick(self) -> None:
        self.left -= 1
        if self.left < 0:
            raise KilledError

    def _hear(self, event: str, arguments: tuple) -> None:
        if self.folder is not None and arguments and event in ACCESSES and str(arguments[0]).startswith(self.folder):
            self.tick()


ACCESSES = {"open", "os.rename", "os.mkdir", "os.remove", "os.rmdir", "os.listdir", "os.scandir", "shutil.rmtree"}
DEATH = Death()


@pytest.fixture(autouse=True)
def line_task(line, monkeypatch):
    with_line(monkeypatch, line)
    yield
    DEATH.disarm()


def status(folder: Path) -> str:
    return json.loads((folder / results.MANIFEST).read_text(encoding="utf-8"))["status"]


@pytest.fixture(scope="module")
def made(line, tmp_path_factory):
    """Contents of a sweep's folder that was never stopped; and one stopped after three of a batch's four rounds."""
    with pytest.MonkeyPatch.context() as patch:
        with_line(patch, line)
        folder = tmp_path_factory.mktemp("whole") / "out"
        assert call(*LINE, "--out", folder) == 0
        stopped = tmp_path_factory.mktemp("stopped") / "out"
        stop_after(patch, 4 + 3)
        assert call(*LINE, "--out", stopped) == 143
    return contents(folder), stopped


@pytest.fixture
def whole(made):
    assert len(made[0]) == 4 + 2
    return made[0]


@pytest.fixture
def stopped(made, tmp_path):
    """A copy of the stopped sweep: its first batch is done, of the second there are checkpoints after rounds 2 and 3."""
    shutil.copytree(made[1], tmp_path / "out")
    return tmp_path / "out"


def stop_after(patch, chunks: int) -> None:
    """SIGTERM comes in that chunk."""
    advanced, left = underway.Keeper.advanced, [chunks]

    def hear(self, *arguments):
        left[0] -= 1
        if left[0] == 0:
            os.kill(os.getpid(), signal.SIGTERM)
        advanced(self, *arguments)

    patch.setattr(underway.Keeper, "advanced", hear)


# --- stopped and killed ---------------------------------------------------------------------------------------------------


def test_a_terminated_sweep_says_how_to_continue_and_does(whole, tmp_path, capsys, monkeypatch):
    with monkeypatch.context() as patch:
        stop_after(patch, 4 + 2)
        assert call(*LINE, "--out", tmp_path) == 143
    error = capsys.readouterr().err
    assert (
        f"2 of 4 rows are finished and kept in {tmp_path}; continue with: {command.PROG} --resume --out {tmp_path}"
        in error
    )
    assert status(tmp_path) == "interrupted"
    assert contents(tmp_path)["runs/line-sac-seed0.msgpack"] == whole["runs/line-sac-seed0.msgpack"]
    assert call("--resume", "--out", tmp_path) == 0
    assert "from round 2 on" in capsys.readouterr().err
    assert contents(tmp_path) == whole
    assert status(tmp_path) == "complete"
    assert call("--resume", "--out", tmp_path) == 0
    assert "nothing to continue" in capsys.readouterr().out


def test_killed_at_the_very_end(whole, tmp_path, monkeypatch, capsys):
    def die(folder):
        raise KilledError

    with monkeypatch.context() as patch:
        patch.setattr(journal, "close", die)
        with pytest.raises(KilledError):
            call(*LINE, "--out", tmp_path)
    assert status(tmp_path) == "complete"
    assert (tmp_path / "progress").exists()
    assert call("--resume", "--out", tmp_path) == 0
    assert "nothing to continue" in capsys.readouterr().out
    assert contents(tmp_path) == whole


@pytest.mark.slow
def test_killed_anywhere_and_continued(whole, tmp_path, monkeypatch):
    """The same command again and again, as a script would give it, until the sweep is complete; and so on."""
    chance, kills, trainings = random.Random(0), 0, 0
    advanced, run = underway.Keeper.advanced, program.Program.run

    def hear(self, *arguments):
        DEATH.tick()
        advanced(self, *arguments)
        DEATH.tick()

    def run_unfinished(self, configs, *arguments):
        done = [json.loads(files.unseal(path.read_bytes()))["runs"] for path in folder.glob("progress/batch-*.json")]
        assert not {f"line-sac-seed{config.seed}" for config in configs} & set().union(*done), (
            "a finished run runs again"
        )
        return run(self, configs, *arguments)

    monkeypatch.setattr(underway.Keeper, "advanced", hear)
    monkeypatch.setattr(program.Program, "run", run_unfinished)
    while kills < KILLS:
        folder = tmp_path / str(trainings)
        trainings += 1
        code = None
        while code is None:
            DEATH.arm(folder, after=chance.randrange(ACCESSES_OF_A_SWEEP))
            try:
                code = call("--resume", *LINE, "--out", folder)
            except KilledError:
                kills += 1
            DEATH.disarm()
        assert code == 0
        assert contents(folder) == whole
    assert trainings > 5


ACCESSES_OF_A_SWEEP = 600  # or so


@pytest.mark.slow
def test_a_process_that_is_killed_is_continued(compiled, tmp_path):
    flags = ["--env", "nav-d1", "--method", "sac", "--seeds", "2", "--total-steps", "1200", *SIZES]
    process = start(compiled, *flags, "--out", tmp_path / "whole")
    _, error = process.communicate(timeout=600)
    assert process.returncode == 0, error
    chance, folder = random.Random(0), tmp_path / "out"
    for rounds in (3, 17):
        process = start(compiled, "--resume", *flags, "--out", folder)
        while process.poll() is None and not list(folder.glob(f"progress/batch-00000/rounds-{rounds:08d}")):
            time.sleep(0.002)
        time.sleep(chance.uniform(0, 0.05))
        process.kill()
        process.communicate()
        assert process.returncode == -signal.SIGKILL
    process = start(compiled, "--resume", "--out", folder)
    _, error = process.communicate(timeout=600)
    assert process.returncode == 0, error
    assert "from round" in error
    assert contents(folder) == contents(tmp_path / "whole")


# --- damaged --------------------------------------------------------------------------------------------------------------


def damage(path: Path, chance: random.Random) -> None:
    """One of the ways in which a file ends up as something else."""
    content = bytearray(path.read_bytes())
    way = chance.choice(["missing", "empty", "truncated", "flipped", "longer"])
    if way == "missing":
        path.unlink()
    elif way == "empty":
        path.write_bytes(b"")
    elif way == "truncated":
        path.write_bytes(content[: chance.randrange(len(content))])
    elif way == "flipped":
        content[chance.randrange(len(content))] ^= 1 << chance.randrange(8)
        path.write_bytes(content)
    else:
        path.write_bytes(content + b"\0")


def test_a_damaged_checkpoint_gives_way_to_the_one_before(stopped, tmp_path, line, capsys):
    configs = [line.replace(method="sac", seed=seed) for seed in (2, 3)]
    empty = program.empty_progress(configs[0], 2)
    about = json.loads(files.unseal(next(stopped.glob("progress/*/rounds-*3/checkpoint.json")).read_bytes()))
    about = {name: about[name] for name in ("peps-jax", "jax", "jaxlib", "devices", "configuration", "runs")}
    source = stopped / "progress" / "batch-00001"
    assert [path.name for path in sorted(source.iterdir())] == ["rounds-00000002", "rounds-00000003"]
    chance = random.Random(1)
    before = None
    for number in range(CORRUPTIONS):
        folder = tmp_path / f"copy{number}"
        shutil.copytree(source, folder)
        damaged = sorted(path for path in folder.glob("rounds-00000003/**/*") if path.is_file())
        damage(chance.choice(damaged), chance)
        found = checkpoints.Checkpoints(folder, about).latest(empty)
        assert found.rounds == 2
        assert "is damaged" in capsys.readouterr().err
        if before is not None:
            jax.tree.map(np.testing.assert_array_equal, (found.state, found.curves), (before.state, before.curves))
        before = found
        if number == 0:
            damage(chance.choice([path for path in folder.rglob("*") if path.is_file()]), chance)
            assert checkpoints.Checkpoints(folder, about).latest(empty) is None, "then from the beginning"


@pytest.mark.parametrize(
    ("pattern", "said"),
    [
        ("progress/batch-00001/rounds-00000003/arrays/**/*", "from round 2 on"),
        ("progress/batch-00001/*/checkpoint.json", "is damaged"),
        ("runs/*.msgpack", "is trained again"),
        ("progress/batch-00000.json", "is trained again"),
    ],
)
def test_a_sweep_with_damaged_files_is_continued(pattern, said, stopped, whole, capsys):
    for path in [path for path in stopped.glob(pattern) if path.is_file()]:
        path.write_bytes(path.read_bytes()[:-1])
    assert call("--resume", "--out", stopped) == 0
    assert said in capsys.readouterr().err
    assert contents(stopped) == whole


@pytest.mark.parametrize("name", ["deep", "tief-größe", "no \udcff text"])
def test_a_state_is_restored_as_it_was(name, line, tmp_path):
    config = line.replace(method="peps", seed=3)
    state = jax.jit(jax.vmap(program.begin))(program.stack([config, config.replace(seed=4)]))
    progress = program.Progress(
        7, program._on_host(state, 2), {"return_": np.array([[1.0, np.nan]] * 2, np.float32)}, 1.25
    )
    kept = checkpoints.Checkpoints(tmp_path / name / "folder", {"of": "this"})
    empty = program.empty_progress(config, 2)
    assert kept.latest(empty) is None
    kept.save(progress)
    restored = kept.latest(empty)
    jax.tree.map(np.testing.assert_array_equal, restored, progress)
    assert jax.tree.structure(restored.state) == jax.tree.structure(progress.state)
    with pytest.raises(checkpoints.IncompatibleError, match="has of this, not that"):
        checkpoints.Checkpoints(tmp_path / name / "folder", {"of": "that"}).latest(empty)
    with pytest.raises(checkpoints.IncompatibleError, match="doesn't have"):
        kept.latest(program.empty_progress(line.replace(method="sac"), 2))


def test_checkpoints_by_the_clock_take_a_small_share_of_it(monkeypatch):
    clock = [0.0]
    monkeypatch.setattr(checkpoints.time, "monotonic", lambda: clock[0])
    rhythm = checkpoints.Rhythm(60.0)
    spent = 0.0
    for _ in range(10_000):
        clock[0] += 3.0
        if rhythm.due():
            with rhythm.making():
                clock[0] += 2.0
                spent += 2.0
    assert 0.005 * clock[0] < spent < 0.02 * clock[0]
    assert checkpoints.Rhythm(0.0).due()


# --- refused --------------------------------------------------------------------------------------------------------------


def rewrite(path: Path, change) -> None:
    """Changes a sealed JSON file, checksum included."""
    content = json.loads(files.unseal(path.read_bytes()))
    change(content)
    path.write_bytes(files.seal(files.json_bytes(content)))


@pytest.mark.parametrize(
    ("flags", "parts"),
    [
        (["--lam", "1.5"], ("lam 1.5 doesn't agree", "2.4", "leave that flag out")),
        (["--seeds", "5"], ("seeds 5 doesn't agree",)),
        (["--overwrite"], ("resume and overwrite",)),
        (["--checkpoint-every", "-1"], ("checkpoint_every -1.0", "0 or more")),
        (["--checkpoint-every", "nan"], ("checkpoint_every nan",)),
        (["--process", "1", "--processes", "2"], ("coordinator is missing",)),
        (["--process", "2", "--processes", "2", "--coordinator", "here:1"], ("process 2", "choose 0 to 1")),
        (["--process", "0", "--processes", "1", "--coordinator", "here"], ("coordinator 'here'", "HOST:PORT")),
    ],
)
def test_flags_that_do_not_agree(flags, parts, stopped, capsys):
    before = contents(stopped)
    assert call("--resume", *flags, "--out", stopped) == 2
    error = capsys.readouterr().err
    assert error.startswith(PREFIX)
    assert error.count("\n") == 1
    assert all(part in error for part in parts), error
    assert contents(stopped) == before


def test_flags_that_agree(stopped, whole):
    assert call("--resume", *LINE, "--lam", "2.4", "2.4", "--out", stopped) == 0
    assert contents(stopped) == whole


def change_manifest(folder: Path) -> None:
    path = folder / results.MANIFEST
    manifest = json.loads(path.read_text(encoding="utf-8"))
    manifest["configuration"]["batch_size"] = 32
    path.write_text(json.dumps(manifest), encoding="utf-8")


@pytest.mark.parametrize(
    ("change", "parts"),
    [
        (change_manifest, ("was begun with configuration",)),
        (lambda folder: (folder / results.MANIFEST).write_text("{", encoding="utf-8"), ("manifest.json is broken",)),
        (lambda folder: (folder / "progress/plan.json").unlink(), ("plan.json is missing",)),
        (lambda folder: (folder / "progress/plan.json").write_text("{}", encoding="utf-8"), ("is damaged",)),
        (lambda folder: rewrite(folder / "progress/plan.json", lambda plan: plan.update(format=0)), ("format 0",)),
        (lambda folder: rewrite(folder / "progress/plan.json", lambda plan: plan.update(jax="0.4.2")), ("jax 0.4.2",)),
        (
            lambda folder: rewrite(
                next(folder.glob("progress/*/rounds-*3/checkpoint.json")), lambda head: head.update(format=7)
            ),
            ("has format 7", "2 of 4 rows are finished"),
        ),
    ],
)  # fmt: skip
def test_what_cannot_be_continued_is_said_and_left_alone(change, parts, stopped, capsys):
    change(stopped)
    before = contents(stopped)
    assert call("--resume", "--out", stopped) == 2
    error = capsys.readouterr().err.splitlines()[-1]
    assert error.startswith(PREFIX)
    assert all(part in error for part in parts), error
    after = contents(stopped)
    for name in before:
        assert name in after
        assert after[name] == before[name] or name == "progress/plan.json"


def test_nothing_to_continue(tmp_path, capsys):
    assert call("--resume", "--out", tmp_path / "nowhere") == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert "holds no sweep to continue" in error
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("number", "message"), [(errno.ENOSPC, "No space left on device"), (errno.EACCES, "Permission denied")]
)
@pytest.mark.parametrize("after", [0, 5, 40, 90])
def test_a_disk_that_refuses_is_said_and_loses_nothing(number, message, after, stopped, whole, capsys, monkeypatch):
    left, fsync = [after], os.fsync

    def refuse(file):
        left[0] -= 1
        if left[0] < 0:
            raise OSError(number, os.strerror(number))
        fsync(file)

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", refuse)
        code = call("--resume", "--out", stopped)
    error = capsys.readouterr().err.splitlines()[-1]
    assert code == (2 if left[0] < 0 else 0)
    if code:
        assert error.startswith(PREFIX)
        assert message in error
        assert call("--resume", "--out", stopped) == 0
    assert contents(stopped) == whole


def test_a_full_disk_is_told_from_what_orbax_raises(line, tmp_path, monkeypatch):
    class Full:
        def __init__(self, *arguments):
            raise ValueError("RESOURCE_EXHAUSTED: Error writing 'x': No space left on device [source locations]")

    state = program._on_host(jax.jit(jax.vmap(program.begin))(program.stack([line.replace(method="sac")])), 1)
    monkeypatch.setattr(checkpoints._orbax(), "Checkpointer", Full)
    with pytest.raises(files.NotWrittenError, match="can't be written: No space left on device"):
        checkpoints.Checkpoints(tmp_path / "new", {}).save(program.Progress(1, state, {}, 0.0))
    assert not list((tmp_path / "new").iterdir())


def test_files_are_whole_or_not_there(tmp_path):
    files.write_whole(tmp_path / "file", b"old")
    files.write_whole(tmp_path / "file", b"new")
    assert (tmp_path / "file").read_bytes() == b"new"
    with pytest.raises(files.NotWrittenError, match=r"can't be written: No such file"):
        files.write_whole(tmp_path / "nowhere" / "file", b"")
    with pytest.raises(files.NotWrittenError, match="can't be made"):
        files.make_folder(tmp_path / "file" / "folder")
    assert [path.name for path in tmp_path.iterdir()] == ["file"]
    assert files.unseal(files.seal(b"content")) == b"content"
    for damaged in (b"", b"content", files.seal(b"content")[:-1], files.seal(b"content") + b"\n"):
        with pytest.raises(files.DamagedError):
            files.unseal(damaged)


def test_a_plan_belongs_to_what_it_was_made_for(tmp_path):
    plan = journal.Plan((journal.Planned(("a", "b"), 2),), ((0,), ()), "now")
    journal.Journal(tmp_path, {"jax": "1"}).begin(plan)
    assert journal.Journal(tmp_path, {"jax": "1"}).plan() == plan
    with pytest.raises(ValueError, match="was begun with jax 1, and this is 2"):
        journal.Journal(tmp_path, {"jax": "2"}).plan()
