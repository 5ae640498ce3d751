"""Files that survive a kill: each is whole or not there, and what was damaged since is noticed.

A process may end at any moment, between any two of these functions' steps, without a reader seeing a half.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import shutil
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

TEMPORARY = ".unfinished-"  # beginning of the name of what isn't in its place yet
_SEAL = b"sha256 "
_SEAL_LENGTH = len(_SEAL) + 64 + 1  # and a line's end


class NotWrittenError(Exception):
    """The system refused to write; one line says what and why."""


class DamagedError(ValueError):
    """A file isn't what was written."""


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
    """

    def write(unfinished: Path) -> None:
        with open(unfinished, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())

    _put_in_place(path, write)


def write_folder(path: Path, fill: Callable[[Path], None]) -> None:
    """Writes a folder as `write_whole` does a file: `fill` gets an empty one, whose files are then moved to `path` at once.

    What is at `path` already is removed just before.

    Raises:
      NotWrittenError: there is no room, or no permission.
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
        parent = Path(tempfile.mkdtemp(dir=path.parent, prefix=f"{TEMPORARY}{path.name}-"))
        try:
            write(parent / path.name)
            os.replace(parent / path.name, path)
            _sync(path.parent)
        finally:
            shutil.rmtree(parent, ignore_errors=True)
    except OSError as error:
        raise NotWrittenError(f"{str(path)!r} can't be written: {error.strerror or error}") from None


def _sync(path: Path) -> None:
    """Waits until a file, or a folder's list of names, is on the disk."""
    number = os.open(path, os.O_RDONLY)
    try:
        os.fsync(number)
    finally:
        os.close(number)


def make_folder(path: Path) -> None:
    """Makes a folder and those above it. Raises NotWrittenError if that can't be."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise NotWrittenError(f"folder {str(path)!r} can't be made: {error.strerror or error}") from None


def remove(path: Path) -> None:
    """Removes a folder, if it is there: at once for a reader, who never sees a part of it."""
    leaving = path.with_name(f"{TEMPORARY}{path.name}-removed-{os.getpid()}")
    try:
        os.replace(path, leaving)
    except FileNotFoundError:
        return
    except OSError as error:
        raise NotWrittenError(f"{str(path)!r} can't be removed: {error.strerror or error}") from None
    shutil.rmtree(leaving, ignore_errors=True)


def remove_unfinished(folder: Path) -> None:
    """Removes what processes that were killed have left, in `folder` and the folders inside."""
    for path in [*folder.rglob(f"{TEMPORARY}*")]:
        shutil.rmtree(path, ignore_errors=True)


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
