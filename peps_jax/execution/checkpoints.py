"""Checkpoints of a batch between two rounds: Orbax writes the arrays, checksums tell whether they are still what was written.

    rounds-00000040/arrays/          Orbax's
    rounds-00000040/checkpoint.json  what it is about, and every file's checksum; sealed

The last `KEPT` are kept, so that one which is damaged has another before it. A folder appears with everything in it, or not
at all.
"""

from __future__ import annotations

import contextlib
import errno
import json
import logging
import os
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np

from peps_jax.execution.program import Progress
from peps_jax.storage import files
from peps_jax.train import TrainingState

FORMAT = 2  # of the folder's content; another one isn't read
KEPT = 2
COST = 0.01  # of the time, at most, goes into checkpoints that are made by the clock
HEAD, ARRAYS, PREFIX = "checkpoint.json", "arrays", "rounds-"


class IncompatibleError(ValueError):
    """A checkpoint is of something else: other settings, other versions."""


class Rhythm:
    """When a checkpoint is due: every so many seconds, and more seldom where they take long.

    Args:
      every: s; 0: at every opportunity.
      at_once: whether the first one is due immediately.
    """

    def __init__(self, every: float, at_once: bool = False):
        self._every = every
        self._latest, self._cost = float("-inf") if at_once else time.monotonic(), 0.0

    def due(self) -> bool:
        """Whether it is time for one."""
        pause = max(self._every, self._cost / COST) if self._every else 0.0
        return time.monotonic() - self._latest >= pause

    @contextlib.contextmanager
    def making(self) -> Iterator[None]:
        """Around the making of one: takes its time."""
        start = time.monotonic()
        yield
        self._latest = time.monotonic()
        self._cost = self._latest - start


def prepare() -> None:
    """Imports Orbax meanwhile, which takes its time; the program's compilation needs as long."""
    threading.Thread(target=_orbax, daemon=True).start()


def _orbax() -> Any:
    import orbax.checkpoint

    logging.getLogger("absl").setLevel(logging.CRITICAL)  # it tells every step, and what it raises a second time
    return orbax.checkpoint


@contextlib.contextmanager
def _spelled_in_unicode(folder: Path) -> Iterator[Path]:
    """An absolute path of `folder` that Orbax can read: its own or, where that is no Unicode, one that leads there meanwhile."""
    absolute = folder.absolute()
    if not any("\ud800" <= character <= "\udfff" for character in str(absolute)):
        yield absolute
        return
    # its name isn't UTF-8, or the locale knows ASCII alone
    with tempfile.TemporaryDirectory() as aside:
        link = Path(aside) / "folder"
        link.symlink_to(absolute, target_is_directory=True)
        yield link


class Checkpoints:
    """Those of one batch, in a folder of their own.

    Args:
      folder: theirs alone; it need not exist.
      about: what has to be equal for a checkpoint to be read: versions, settings, runs. JSON knows it.
    """

    def __init__(self, folder: Path, about: Mapping[str, Any]):
        self._folder = folder
        self._about = {"format": FORMAT, **about}

    def save(self, progress: Progress) -> None:
        """Writes one, and removes the oldest.

        Raises:
          NotWrittenError: there is no room, or no permission; those before it are kept.
        """
        files.make_folder(self._folder)
        name = f"{PREFIX}{progress.rounds:08d}"
        files.write_folder(self._folder / name, lambda folder: self._fill(folder, progress))
        for old in self._all()[:-KEPT]:
            files.remove(old)

    def _fill(self, folder: Path, progress: Progress) -> None:
        state = {f"{place:04d}": leaf for place, leaf in enumerate(jax.tree.leaves(progress.state)) if leaf.size}
        try:
            with (
                _spelled_in_unicode(folder) as place,
                _orbax().Checkpointer(_orbax().PyTreeCheckpointHandler()) as checkpointer,
            ):
                checkpointer.save(place / ARRAYS, {"state": state, "curves": dict(progress.curves)})
        except OSError:
            raise
        except Exception as error:  # what its storage raises has the system's message in it, and no type of its own
            full = os.strerror(errno.ENOSPC)
            raise OSError(errno.EIO, full if full in str(error) else str(error).splitlines()[0][:200]) from error
        head = self._about | {
            "rounds": progress.rounds,
            "seconds": progress.seconds,
            "shapes": _shapes(progress.state),
            "checksums": files.checksums(folder),
        }
        (folder / HEAD).write_bytes(files.seal(files.json_bytes(head)))

    def latest(self, empty: TrainingState) -> Progress | None:
        """The last one that is whole, or None if there is none. Damaged ones are said on stderr, and removed.

        Args:
          empty: shapes and types of the state.

        Raises:
          IncompatibleError: it is of something else.
        """
        for folder in reversed(self._all()):
            try:
                return self._read(folder, empty)
            except files.DamagedError as error:
                print(f"checkpoint {str(folder)!r} is damaged ({error}): going on from the one before", file=sys.stderr)
                files.remove(folder)  # or it would count as one of those kept
        return None

    def _read(self, folder: Path, empty: TrainingState) -> Progress:
        try:
            head = json.loads(files.unseal((folder / HEAD).read_bytes()))
        except OSError:
            raise files.DamagedError(f"{HEAD} is missing") from None
        for name, value in self._about.items():
            if head.get(name) != value:
                raise IncompatibleError(
                    f"checkpoint {str(folder)!r} has {name} {_short(head.get(name))}, not {_short(value)}: "
                    "go on with what wrote it, or start again with --overwrite"
                )
        found = {path: sum_ for path, sum_ in files.checksums(folder).items() if path != HEAD}
        for path, expected in head["checksums"].items():
            if found.get(path) != expected:
                raise files.DamagedError(f"{path} has changed" if path in found else f"{path} is missing")
        if head["shapes"] != _shapes(empty):
            raise IncompatibleError(
                f"checkpoint {str(folder)!r} is of a state that this version doesn't have: "
                "go on with the version that wrote it, or start again with --overwrite"
            )
        with (
            _spelled_in_unicode(folder) as place,
            _orbax().Checkpointer(_orbax().PyTreeCheckpointHandler()) as checkpointer,
        ):
            stored = checkpointer.restore(place / ARRAYS)
        leaves, tree = jax.tree.flatten(empty)
        whole = lambda place, leaf: np.asarray(
            stored["state"][f"{place:04d}"] if leaf.size else np.zeros(leaf.shape, leaf.dtype)
        )
        state = jax.tree.unflatten(tree, [whole(place, leaf) for place, leaf in enumerate(leaves)])
        curves = {name: np.asarray(values) for name, values in stored["curves"].items()}
        return Progress(head["rounds"], state, curves, head["seconds"])

    def remove(self) -> None:
        """Removes all: the batch is done."""
        files.remove(self._folder)

    def _all(self) -> list[Path]:
        """Their folders, the latest last."""
        return sorted(self._folder.glob(f"{PREFIX}*"))


def _shapes(state: TrainingState) -> list[list[Any]]:
    leaves = jax.tree_util.tree_leaves_with_path(state)
    return [[jax.tree_util.keystr(path), str(leaf.dtype), list(leaf.shape)] for path, leaf in leaves]


def _short(value: Any) -> str:
    return value[:12] if isinstance(value, str) else str(value)
