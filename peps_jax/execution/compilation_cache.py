"""Compiled programs that outlive their process, so that what was compiled once starts in a second.

JAX's own persistent cache knows a program by what tracing makes of it, and tracing takes longer than all the rest of a warm
start. Here a program is known by what decides the tracing: the code of both packages, versions, settings of JAX, the machine,
and a text that its maker gives. Whatever can't be read, or doesn't load, is made anew.

Programs are kept in `folder()`, the least recently used beyond `LIMIT` bytes removed. `PEPS_JAX_CACHE` names another folder, or
turns this off if it is empty. Loading runs what the files hold: the folder has to be the user's own.
"""

from __future__ import annotations

import contextlib
import functools
import gc
import os
import pickle
import platform
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax.experimental import serialize_executable

from peps_jax.execution import machine
from peps_jax.storage import code, files

VARIABLE = "PEPS_JAX_CACHE"
LIMIT = 2 * 10**9  # bytes
_SUFFIX = ".program"


def folder() -> Path | None:
    """Where programs are kept; None where they aren't."""
    named = os.environ.get(VARIABLE)
    if named is not None:
        return Path(named) if named else None
    with contextlib.suppress(RuntimeError):  # nobody's home
        return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "peps_jax"
    return None


def kept(
    about: str | None,
    make: Callable[[], Mapping[str, Any]],
    devices: Sequence[jax.Device] | None = None,
    options: Mapping[str, Mapping[str, Any]] | None = None,
) -> dict[str, Any]:
    """Compiled programs by name, and other values that can be pickled: from an earlier process, or from `make`.

    Args:
      about: what decides them, beside what holds for everything here; None if that can't be told.
      make: gives programs as they are lowered, which are compiled here, side by side; other values stay as they are.
      devices: of the programs; all by default.
      options: of the compiler, by the programs' names.
    """
    place, devices = folder(), jax.devices() if devices is None else list(devices)
    if place is None or about is None or jax.process_count() > 1:  # another process has other devices
        return _compiled(_traced(make), options or {})
    path = place / (files.json_digest([about, [device.id for device in devices], *_surroundings()]) + _SUFFIX)
    with contextlib.suppress(Exception):  # whatever is wrong with a file, it can be made again
        found = _unpacked(files.unseal(path.read_bytes()), devices)
        os.utime(path)
        return found
    to_make = _traced(make)
    hits = _jax_hits[0]
    with _unseen_by_jax():
        made = _compiled(to_make, options or {})
    if _jax_hits[0] > hits:
        return made
    with contextlib.suppress(Exception):  # no room, a backend that can't write programs: what isn't kept runs as well
        files.make_folder(place)
        files.write_whole(path, files.seal(_packed(made)))
        _make_room(place)
    return made


def _traced(make: Callable[[], Mapping[str, Any]]) -> Mapping[str, Any]:
    """What `make` gives. Tracing makes many objects, and hardly any garbage: to look for it takes a sixth of the time."""
    collected = gc.isenabled()
    gc.disable()
    try:
        return make()
    finally:
        if collected:
            gc.enable()


def _compiled(values: Mapping[str, Any], options: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    lowered = {name: value for name, value in values.items() if isinstance(value, jax.stages.Lowered)}
    with ThreadPoolExecutor() as pool:  # the compiler works outside Python's lock
        done = pool.map(lambda name: lowered[name].compile(compiler_options=dict(options.get(name, {}))), lowered)
        return dict(values) | dict(zip(lowered, done, strict=True))


# A program that came from JAX's own cache can't be written again: what is read back of it lacks functions, and says so when it
# runs. So JAX isn't given programs that are kept here, and what it has nevertheless isn't kept.
_jax_hits = [0]


def _count_hits(event: str, **_: Any) -> None:
    _jax_hits[0] += event == "/jax/compilation_cache/cache_hits"


jax.monitoring.register_event_listener(_count_hits)


@contextlib.contextmanager
def _unseen_by_jax() -> Iterator[None]:
    """JAX's own persistent cache keeps nothing that is compiled meanwhile."""
    name = "jax_persistent_cache_min_compile_time_secs"
    before = getattr(jax.config, name)
    jax.config.update(name, float("inf"))
    try:
        yield
    finally:
        jax.config.update(name, before)


def _packed(values: Mapping[str, Any]) -> bytes:
    programs = {
        name: serialize_executable.serialize(value)
        for name, value in values.items()
        if isinstance(value, jax.stages.Compiled)
    }
    return pickle.dumps((programs, {name: value for name, value in values.items() if name not in programs}))


def _unpacked(content: bytes, devices: Sequence[jax.Device]) -> dict[str, Any]:
    programs, values = pickle.loads(content)
    with ThreadPoolExecutor() as pool:
        load = lambda packed: serialize_executable.deserialize_and_load(*packed, execution_devices=devices)
        loaded = pool.map(load, programs.values())
        return values | dict(zip(programs, loaded, strict=True))


def _make_room(place: Path) -> None:
    """Removes the programs that were longest not used, until those left are within `LIMIT`."""
    found = sorted(((path.stat(), path) for path in place.glob(f"*{_SUFFIX}")), key=lambda one: -one[0].st_mtime)
    sizes = np.cumsum([status.st_size for status, _ in found])
    for total, (_, path) in zip(sizes, found, strict=True):
        if total > LIMIT:
            path.unlink(missing_ok=True)


def _code() -> str:
    """A digest of all code that a program may be made of."""
    return code.digest("peps_jax.train", "peps_jax.evaluate", "peps_jax.execution.batches")


@functools.cache
def _processor() -> str:
    """What the processor is and can do: a program is made for one."""
    with contextlib.suppress(OSError):
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").split("\n\n")[0].splitlines()
        return "\n".join(
            line for line in lines if line.split("\t")[0] in ("model name", "flags", "Features", "CPU part")
        )
    return platform.processor()


def _surroundings() -> list[str]:
    """What decides a program and isn't told by its maker."""
    versions = [f"{name} {version}" for name, version in machine.versions().items()]
    device = jax.devices()[0]
    here = [platform.platform(), _processor(), device.platform, device.device_kind, device.client.platform_version]
    settings = [f"{name} {value}" for name, value in sorted(jax.config.values.items())]
    flags = [os.environ.get(name, "") for name in ("XLA_FLAGS", "LIBTPU_INIT_ARGS")]
    return [_code(), sys.version, *versions, *here, *settings, *flags]
