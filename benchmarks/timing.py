"""Running a function on all of the machine's devices at the same time, and taking its time."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from jax.sharding import NamedSharding, PartitionSpec


def spread(tree: Any, devices: int | None = None) -> Any:
    """`tree`, whose leaves have a leading axis of items, with the items laid over the devices."""
    return jax.device_put(tree, NamedSharding(_mesh(devices), PartitionSpec("items")))


def compiled(
    function: Callable[..., Any], *batched: Any, devices: int | None = None, together: bool = False
) -> tuple[Callable[..., Any], float]:
    """`function` of one item as a program for items that lie over the devices, and the seconds that compiling it took.

    Each device takes its items one after the other, as a sweep does on a CPU, or side by side if they are to be `together`.
    """
    items = PartitionSpec("items")
    over = lambda *batched: (
        jax.vmap(function)(*batched) if together else jax.lax.map(lambda one: function(*one), batched)
    )
    mapped = jax.shard_map(over, mesh=_mesh(devices), in_specs=items, out_specs=items, check_vma=False)
    start = time.perf_counter()
    program = jax.jit(mapped).lower(*batched).compile()
    return program, time.perf_counter() - start


def seconds(program: Callable[..., Any], *batched: Any, repeats: int = 3) -> float:
    """The median time of a call, after one that isn't counted."""
    jax.block_until_ready(program(*batched))
    taken = []
    for _ in range(repeats):
        start = time.perf_counter()
        jax.block_until_ready(program(*batched))
        taken.append(time.perf_counter() - start)
    return float(np.median(taken))


def _mesh(devices: int | None) -> jax.sharding.Mesh:
    return jax.make_mesh(
        (devices or jax.device_count(),), ("items",), devices=jax.devices()[: devices or jax.device_count()]
    )
