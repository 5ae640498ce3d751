"""The folder of a reproduction: what is kept comes back as it was, and whoever has lost the folder keeps nothing there."""

import types

import numpy as np
import pytest
from commands import everything
from records import EPISODES, made_up

from peps_jax.reproduce import __main__ as reproduce
from peps_jax.reproduce import store
from peps_jax.reproduce.store import Record, Store
from peps_jax.storage import files
from peps_jax.storage.ownership import OWNER, OwnershipLostError

LOST = "this run has lost the folder"


def test_a_record_comes_back_as_it_was(tmp_path, tiny):
    kept = Store(tmp_path, tiny, EPISODES, seeds=2)
    kept.open()
    record, recipe = made_up(3.0, failed=True), store.settings_of(tiny)
    assert kept.load("one", recipe) is None
    kept.save("one", recipe, record.arrays())
    again = Record.of(kept.load("one", recipe))
    assert (again.failed, again.seconds) == (True, 1.0)
    np.testing.assert_array_equal(again.routes, record.routes)
    for part in ("mode", "sampled", "heat"):
        assert set(getattr(again, part)) == set(getattr(record, part))
        for name, values in getattr(record, part).items():
            np.testing.assert_array_equal(getattr(again, part)[name], values)
    with pytest.raises(ValueError, match="made with other settings"):
        kept.load("one", store.settings_of(tiny.replace(seed=7)))


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04 half a file"])
def test_a_broken_file_is_said(content, tmp_path, tiny):
    kept = Store(tmp_path, tiny, EPISODES, seeds=2)
    kept.open()
    (tmp_path / store.KEPT / "one.npz").write_bytes(content)
    with pytest.raises(ValueError, match="can't be read: remove it"):
        kept.load("one", {})


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
