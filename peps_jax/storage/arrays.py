"""Arrays by name, with the digest of what made them."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from peps_jax.storage import files


def write_arrays(path: Path, digest: str, arrays: Mapping[str, Any]) -> None:
    """Keeps arrays, and the digest of what made them."""
    buffer = io.BytesIO()
    np.savez_compressed(buffer, digest=np.array(digest), **arrays)
    files.write_whole(path, buffer.getvalue())


def read_arrays(path: Path, digest: str, made_by: str = "settings") -> dict[str, np.ndarray]:
    """What `write_arrays` was given.

    Raises:
      ValueError: it can't be read, or something with another digest made it: other `made_by`.
    """
    try:
        with np.load(io.BytesIO(path.read_bytes())) as file:
            arrays = dict(file)
        found = str(arrays.pop("digest"))
    except (OSError, EOFError, ValueError, KeyError, zipfile.BadZipFile):
        raise ValueError(f"file {str(path)!r} can't be read: remove it, and it is made again") from None
    if found != digest:
        raise ValueError(f"file {str(path)!r} was made with other {made_by}: choose another folder")
    return arrays
