"""A folder is one run's at a time: who comes back late, or second, writes nothing, and says so in one line."""

import ast
import itertools
import sys
import threading
from pathlib import Path

import pytest
from commands import everything

import peps_jax
from peps_jax.storage import files
from peps_jax.storage.ownership import Owner, OwnershipLostError, owners

# a process that loses its folder inside one of Orbax's calls takes its threads with it; here they come back
pytestmark = pytest.mark.filterwarnings("ignore:(?s).*Event loop is closed:pytest.PytestUnraisableExceptionWarning")

LOST = "this run has lost the folder"


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
