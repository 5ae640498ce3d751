"""What computes: versions and devices, as a results folder tells them."""

from __future__ import annotations

import importlib.metadata
import platform
from typing import Any

import jax

PACKAGES = ("peps-jax", "jax", "jaxlib", "flax", "optax", "distrax", "chex", "numpy")


def describe() -> dict[str, Any]:
    """Versions of what computes, and the devices."""
    versions = {"python": platform.python_version()}
    for package in PACKAGES:
        try:
            versions[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            versions[package] = "not installed"
    devices = [{"platform": device.platform, "kind": device.device_kind} for device in jax.devices()]
    return {"versions": versions, "devices": devices}
