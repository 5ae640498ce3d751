"""Trainings of one structure, laid over the machine's devices and compiled apart from their run."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import jax
from jax.sharding import NamedSharding, PartitionSpec

from peps_jax import Config, batch


def compile_over_devices(function: Callable[[Config], Any], configs: Sequence[Config]) -> tuple[Any, Config]:
    """The compiled program of `function` for all `configs`, one at a time on each device, and what to call it with.

    Results have a leading axis of cells: the given ones, and then copies of the last that fill up the devices.
    """
    mesh, spec = jax.make_mesh((jax.device_count(),), ("cells",)), PartitionSpec("cells")
    padded = [*configs, *[configs[-1]] * (-len(configs) % jax.device_count())]
    cells = jax.device_put(batch.stack(padded), NamedSharding(mesh, spec))
    on_device = lambda cells: jax.lax.map(function, cells)
    mapped = jax.shard_map(on_device, mesh=mesh, in_specs=spec, out_specs=spec, check_vma=False)
    return jax.jit(mapped).lower(cells).compile(), cells
