"""What computes: the devices, met once, and versions and devices as a results folder tells them."""

from __future__ import annotations

import contextlib
import functools
import importlib.metadata
import os
import platform
import re
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from types import MappingProxyType
from typing import Any

import jax

from peps_jax.execution.waiting import Reminder, print_line

WAIT = 300.0  # s for JAX to find its devices
PACKAGES = ("peps-jax", "jax", "jaxlib", "flax", "optax", "distrax", "chex", "numpy")


def meet_devices() -> None:
    """Lets JAX find its devices, before anything needs one.

    Raises:
      ValueError: it doesn't find those that it was told to use; one line says which, where, and what to look at.
    """
    told: list[Exception] = []

    def meet() -> None:
        try:
            jax.devices()
        except (RuntimeError, AssertionError) as error:
            told.append(error)

    began = time.monotonic()
    # in a thread, for a driver that doesn't answer answers to nothing else either
    meeting = threading.Thread(target=meet, daemon=True)
    with _noise_aside() as (say, noise), Reminder(f"waiting for JAX to find its devices on {platform.node()}", say):
        meeting.start()
        meeting.join(WAIT)
    if told or meeting.is_alive():
        raise ValueError(_no_devices(told, noise, time.monotonic() - began)) from None
    sys.stderr.write("".join(noise))  # that it uses a CPU, for instance, and why


@contextlib.contextmanager
def _noise_aside() -> Iterator[tuple[Callable[[str], None], list[str]]]:
    """Whatever drivers and plugins, in C++ too, print to stderr meanwhile is kept for later.

    Yields:
      What prints a line all the same, and the lines that were kept, once it is over.
    """
    noise: list[str] = []
    try:
        if sys.stderr.fileno() != 2:
            raise OSError
        heard = os.dup(2)
    except (OSError, ValueError, AttributeError):  # it is no file, or there is none
        yield print_line, noise
        return
    with (
        os.fdopen(heard, "w", encoding="utf-8", errors="replace", buffering=1) as stderr,
        tempfile.TemporaryFile() as kept,
    ):
        sys.stderr.flush()
        os.dup2(kept.fileno(), 2)
        try:
            yield lambda line: print(line, file=stderr), noise
        finally:
            sys.stderr.flush()
            os.dup2(heard, 2)
            kept.seek(0)
            noise += kept.read().decode("utf-8", "replace").splitlines(keepends=True)


def _no_devices(told: Sequence[Exception], noise: Sequence[str], seconds: float) -> str:
    """One line about devices that JAX doesn't find."""
    wanted = jax.config.jax_platforms
    raised = [line.strip() for line in noise if re.match(r"\w+(Error|Exception): ", line)]  # the last lines of stacks
    reasons = [*str(told[0]).splitlines()[:1], *raised[-1:], "no plugin for it is installed"] if told else ["no answer"]
    others = f", or use others (JAX_PLATFORMS is {wanted!r}; cpu is everywhere)" if wanted else ""
    return (
        f"JAX found no {wanted or 'usable'} device on {platform.node()} in {seconds:.0f} s ({reasons[0]}): see that the machine "
        f"shows one (nvidia-smi of NVIDIA's) and that JAX is installed for it (the extra `cuda`){others}"
    )


@functools.cache
def versions() -> Mapping[str, str]:
    """Versions of what computes, by its name."""
    found = {"python": platform.python_version()}
    for package in PACKAGES:
        try:
            found[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            found[package] = "not installed"
    return MappingProxyType(found)


def describe() -> dict[str, Any]:
    """Versions of what computes, and the devices."""
    devices = [{"platform": device.platform, "kind": device.device_kind} for device in jax.devices()]
    return {"versions": dict(versions()), "devices": devices}
