"""Files that survive a kill: each is whole or not there, and what was damaged since is noticed.

A process may end at any moment, between any two of these functions' steps, without a reader seeing a half. Inside a folder
that a run has claimed (`peps_jax.storage.ownership`), they write and remove for the folder's owner alone.
"""

from __future__ import annotations

import contextlib
import contextvars
import hashlib
import json
import math
import os
import shutil
import tempfile
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

TEMPORARY = ".unfinished-"  # beginning of the name of what isn't in its place yet
_SEAL = b"sha256 "
_SEAL_LENGTH = len(_SEAL) + 64 + 1  # and a line's end


class NotWrittenError(Exception):
    """The system refused to write; one line says what and why."""


class OwnershipLostError(NotWrittenError):
    """The folder belongs to another run now, so this one may not write there; one line says so."""


class DamagedError(ValueError):
    """A file isn't what was written."""


class Claim(NamedTuple):
    """What lets a run write into a folder."""

    folder: Path  # absolute
    workshop: Path  # in the folder; what is put there or taken away passes through it, so who loses it can do neither

    @property
    def lost(self) -> bool:
        return not os.path.isdir(self.workshop)

    def refusal(self) -> OwnershipLostError:
        return OwnershipLostError(
            f"this run has lost the folder {str(self.folder)!r}, which another one took over (or somebody moved or removed): "
            "it writes nothing there any more"
        )


_CLAIM: contextvars.ContextVar[Claim | None] = contextvars.ContextVar("claim", default=None)


@contextlib.contextmanager
def writing_under(claim: Claim) -> Iterator[None]:
    """Whatever this thread writes into the claimed folder meanwhile is written under that claim."""
    token = _CLAIM.set(claim)
    try:
        yield
    finally:
        _CLAIM.reset(token)


def _claim_on(path: Path) -> Claim | None:
    """The claim under which `path` is written, or None: it lies elsewhere, or nobody claimed its folder."""
    claim = _CLAIM.get()
    inside = claim is not None and Path(os.path.abspath(path)).is_relative_to(claim.folder)
    return claim if inside else None


def _refusal(path: Path, act: str, error: OSError) -> NotWrittenError:
    """Why the system refused to do that: the folder is lost, or it has a reason of its own."""
    claim = _claim_on(path)
    if claim is not None and claim.lost:
        return claim.refusal()
    return NotWrittenError(f"{str(path)!r} can't be {act}: {error.strerror or error}")


def digest(content: bytes) -> str:
    """SHA-256 as text."""
    return hashlib.sha256(content).hexdigest()


def json_digest(value: Any) -> str:
    """SHA-256 of something that JSON knows."""
    return digest(json.dumps(value, sort_keys=True).encode())


def seal(content: bytes) -> bytes:
    """`content` behind a line with its checksum."""
    return _SEAL + digest(content).encode() + b"\n" + content


def unseal(sealed: bytes) -> bytes:
    """What `seal` was given. Raises DamagedError if anything has changed since."""
    content = sealed[_SEAL_LENGTH:]
    if sealed[:_SEAL_LENGTH] != seal(content)[:_SEAL_LENGTH]:
        raise DamagedError("its checksum is wrong")
    return content


def is_sealed(content: bytes) -> bool:
    return content.startswith(_SEAL)


def write_whole(path: Path, content: bytes) -> None:
    """Writes a file so that a reader sees the old one or the new one, never a half; on the disk when this returns.

    Raises:
      NotWrittenError: there is no room, or no permission.
      OwnershipLostError: the folder was claimed, and is another run's now.
    """
    write_with(path, lambda unfinished: unfinished.write_bytes(content))


def write_with(path: Path, write: Callable[[Path], object]) -> None:
    """Like `write_whole`, of a file that something else writes: `write` gets the path where it is to be made, of the same name."""

    def write_synced(unfinished: Path) -> None:
        write(unfinished)
        _sync(unfinished)

    _put_in_place(path, write_synced)


def write_folder(path: Path, fill: Callable[[Path], None]) -> None:
    """Writes a folder as `write_whole` does a file: `fill` gets an empty one, whose files are then moved to `path` at once.

    What is at `path` already is removed just before. Raises what `write_whole` does.
    """

    def write(unfinished: Path) -> None:
        unfinished.mkdir()
        fill(unfinished)
        for inside in (file for file in unfinished.rglob("*") if file.is_file()):
            _sync(inside)
        remove(path)

    _put_in_place(path, write)


def _put_in_place(path: Path, write: Callable[[Path], None]) -> None:
    try:
        with _aside(path) as aside:
            write(aside / path.name)
            os.replace(aside / path.name, path)
            _sync(path.parent)
    except OSError as error:
        raise _refusal(path, "written", error) from None


@contextlib.contextmanager
def _aside(path: Path) -> Iterator[Path]:
    """A folder on the same disk as `path` for what isn't in its place yet, or any more; removed in the end.

    It is beside `path`, or in the workshop of who claimed the folder: then nothing can be moved from here into its place, or
    the other way, once that is another's.
    """
    claim = _claim_on(path)
    if claim is None:
        aside = Path(tempfile.mkdtemp(dir=path.parent, prefix=f"{TEMPORARY}{path.name}-"))
    else:
        aside = Path(tempfile.mkdtemp(dir=claim.workshop))
    try:
        yield aside
    finally:
        shutil.rmtree(aside, ignore_errors=True)


def _sync(path: Path) -> None:
    """Waits until a file, or a folder's list of names, is on the disk."""
    number = os.open(path, os.O_RDONLY)
    try:
        os.fsync(number)
    finally:
        os.close(number)


def make_folder(path: Path) -> None:
    """Makes a folder and those above it. Raises what `write_whole` does."""
    try:
        if _claim_on(path) is None:
            path.mkdir(parents=True, exist_ok=True)
        elif not os.path.isdir(path):
            make_folder(path.parent)
            with _aside(path) as aside:
                (aside / path.name).mkdir()
                os.rename(aside / path.name, path)
    except OSError as error:
        if not os.path.isdir(path):  # another process of the same run may have made it meanwhile
            raise _refusal(path, "made", error) from None


def remove(path: Path) -> None:
    """Removes a file or a folder, if it is there: at once for a reader, who never sees a part of it.

    Raises what `write_whole` does.
    """
    try:
        with _aside(path) as aside:
            os.replace(path, aside / path.name)
    except OSError as error:
        refusal = _refusal(path, "removed", error)
        if os.path.lexists(path) or isinstance(refusal, OwnershipLostError):
            raise refusal from None


def remove_unfinished(folder: Path) -> None:
    """Removes what processes that were killed have left, in `folder` and the folders inside."""
    try:
        for path in [*folder.rglob(f"{TEMPORARY}*")]:
            remove(path)
    except (OSError, NotWrittenError):  # names vanish while they are listed; and what remains does no harm
        claim = _claim_on(folder)
        if claim is not None and claim.lost:
            raise claim.refusal() from None


def checksums(folder: Path) -> dict[str, str]:
    """The SHA-256 of every file in `folder`, by its path inside."""
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    return {path.relative_to(folder).as_posix(): digest(path.read_bytes()) for path in files}


def plain(value: Any) -> Any:
    """`value` as JSON knows it; numbers that it doesn't, inf and nan, as text that `float` reads."""
    if isinstance(value, Mapping):
        return {key: plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)
    return value


def json_bytes(value: Mapping[str, Any]) -> bytes:
    """`value` as a JSON file's content."""
    return (json.dumps(value, indent=1, allow_nan=False) + "\n").encode()


def check_writable(out: Path) -> None:
    """Raises ValueError, in one line, if no folder can be made or written at `out`."""
    existing = next(path for path in (out, *out.absolute().parents) if path.exists())
    if not existing.is_dir():
        raise ValueError(f"out {str(out)!r} can't be a folder: {str(existing)!r} is a file; choose another name")
    if not os.access(existing, os.W_OK):
        raise ValueError(
            f"out {str(out)!r} can't be written: {str(existing)!r} doesn't allow it; choose another folder"
        )
