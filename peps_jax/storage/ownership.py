"""Whose a folder is: one run's at a time, and whoever has lost it can't write there any more.

    .owner/<run>/   the owner's workshop, and all that there is in `.owner`

What a run puts into its folder is made in its workshop and then renamed into place; what it takes out is renamed into the
workshop (`peps_jax.storage.files` does both). Who takes the folder over renames the workshop away, removes it with all that
is in it, and only then puts its own in `.owner`.

So nothing has to be checked before a file is put in place, and no moment lies between check and act: a process that was
suspended anywhere, and wakes up when the folder is another's, finds neither its workshop nor the file that it was about to
rename. There is no lock that a suspended process could hold, nobody waits for anybody, and a process's number means nothing.

Guaranteed where renaming is atomic, on a disk and over NFS: one owner at a time; nothing is put in place or removed for a
run once another's claim has returned; of several claims at once, exactly one or none succeeds. Another host's NFS client may
see a workshop for a while after it was removed, and make files there that the server refuses; it can't put any in place.
Not guaranteed on object stores that look like folders, where renaming is copying.

A run's processes share its workshop: one of them claims, the others know the run's name. What is left of a run that was
killed is an empty workshop, in nobody's way: `--resume` and `--overwrite` take the folder over. A complete folder has none.
"""

from __future__ import annotations

import errno
import os
import shutil
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TypeVar

from peps_jax.storage import files
from peps_jax.storage.files import TEMPORARY, OwnershipLostError

__all__ = ["OWNER", "Owner", "OwnershipLostError", "holds_nothing", "owners"]

OWNER = ".owner"
PERSEVERANCE = 10  # times that a workshop is emptied while its owner may still be adding to it
T = TypeVar("T")


def owners(folder: Path) -> tuple[str, ...]:
    """The run that owns `folder`: none, or one; more only where folders were copied into one another."""
    with suppress(FileNotFoundError, NotADirectoryError):
        return tuple(sorted(os.listdir(folder / OWNER)))
    return ()


def holds_nothing(folder: Path) -> bool:
    """Whether `folder` isn't there or has nothing in it; what tells its owner doesn't count."""
    with suppress(FileNotFoundError):
        return all(name == OWNER or name.startswith(TEMPORARY) for name in os.listdir(folder))
    return True


class Owner:
    """A run that writes into a folder, or one of its processes.

    Args:
      folder: to be claimed; it need not exist.
      run: a name that no other run has; a random one by default.
    """

    def __init__(self, folder: Path, run: str = ""):
        self.run = run or os.urandom(8).hex()
        self._folder = Path(os.path.abspath(folder))
        self._shown = str(folder)
        self._claim = files.Claim(self._folder, self._folder / OWNER / self.run)
        self._released = False

    def claim(self, check: Callable[[], T], over: bool) -> T:
        """Makes the folder this run's, and itself if it isn't there.

        Args:
          check: raises ValueError if the folder isn't as this run needs it. It is called before anything is touched, so that
            who is refused takes nothing from anybody, and again when nobody else can change the folder any more.
          over: from whoever owns it, too.

        Returns:
          What the second `check` did.

        Raises:
          ValueError: `check` did; another run owns the folder; or another one claimed it at the same time.
          NotWrittenError: there is no room, or no permission.
        """
        present = owners(self._folder)
        check()
        if present and not over:
            raise ValueError(
                f"out {self._shown!r} belongs to another run, which has only begun or was killed then: choose another folder, "
                "or add --overwrite to take it over"
            )
        files.make_folder(self._folder)
        try:
            for run in present:
                self._take_from(run)
            self._put_up()
        except OSError as error:
            if error.errno in (errno.ENOENT, errno.ENOTEMPTY, errno.EEXIST):
                raise ValueError(f"out {self._shown!r} was claimed by another run at the same time") from None
            raise files.NotWrittenError(f"out {self._shown!r} can't be claimed: {error.strerror or error}") from None
        try:
            return check()
        except (Exception, KeyboardInterrupt):
            self.release()
            raise

    def _take_from(self, run: str) -> None:
        """Ends the ownership of `run`. Of several that do this at once, one succeeds; the others get FileNotFoundError."""
        taken = Path(tempfile.mkdtemp(dir=self._folder, prefix=f"{TEMPORARY}owner-"))
        try:
            os.rename(self._folder / OWNER / run, taken / run)
        finally:
            for _ in range(PERSEVERANCE):
                shutil.rmtree(taken, ignore_errors=True)
                if not taken.exists():
                    break

    def _put_up(self) -> None:
        """Puts this run's workshop in its place, which has to be empty, or gets OSError."""
        made = Path(tempfile.mkdtemp(dir=self._folder, prefix=f"{TEMPORARY}owner-"))
        try:
            (made / OWNER / self.run).mkdir(parents=True)
            os.rename(made / OWNER, self._folder / OWNER)
        finally:
            shutil.rmtree(made, ignore_errors=True)

    @contextmanager
    def writing(self) -> Iterator[None]:
        """What this thread writes into the folder meanwhile is written for this run.

        Raises:
          OwnershipLostError: in place of whatever goes wrong once the folder is another's, such as files that are missing.
        """
        try:
            with files.writing_under(self._claim):
                yield
        except OwnershipLostError:
            raise
        except Exception:
            if not self._released:
                self.check()
            raise

    def check(self) -> None:
        """Raises OwnershipLostError if the folder isn't this run's any more."""
        if self._claim.lost:
            raise self._claim.refusal() from None

    def release(self) -> None:
        """Gives the folder back, if it is still this run's: nothing of the ownership remains in it."""
        self._released = True
        if not self._claim.lost:
            with suppress(OSError):
                self._take_from(self.run)
                os.rmdir(self._folder / OWNER)
