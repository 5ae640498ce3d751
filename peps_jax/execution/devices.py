"""How many runs of one function are laid on devices: an equal share for each.

On a CPU each device works through its runs one after the other, which is quicker than side by side (their working memory stays
in the cache); an accelerator takes its runs side by side.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding
from jax.sharding import PartitionSpec as P


def side_by_side(devices: Sequence[jax.Device]) -> bool:
    """Whether a device works on its runs at the same time (`vmap`) or one after the other (`lax.map`)."""
    return devices[0].platform != "cpu"


def stack(trees: Sequence[Any]) -> Any:
    """One tree whose every leaf has a leading axis of runs."""
    return jax.tree.map(lambda *leaves: jnp.asarray(np.stack([np.asarray(leaf) for leaf in leaves])), *trees)


def padded(values: Sequence[Any], slots: int) -> list[Any]:
    """As many as there are slots, since every device gets as many: the last one again and again; dropped in the end."""
    return [*values, *[values[-1]] * (slots - len(values))]


def sharding(devices: Sequence[jax.Device]) -> NamedSharding:
    """A leading axis of runs, divided between `devices`."""
    return NamedSharding(Mesh(np.asarray(devices), ("runs",)), P("runs"))


def over_devices(
    function: Callable[..., Any],
    devices: Sequence[jax.Device],
    whole: tuple[int, ...] = (),
    donate: tuple[int, ...] = (),
) -> Any:
    """`function` of one run, jitted for all: arguments and results have a leading axis of runs, but for arguments `whole`.

    What is whole stays unbatched inside, so that a round writes one slice of every replay and no scatter.
    """

    def on_device(*arguments: Any) -> Any:
        batched = [argument for place, argument in enumerate(arguments) if place not in whole]

        def one(batched: list[Any]) -> Any:
            rest = iter(batched)
            return function(*(arguments[place] if place in whole else next(rest) for place in range(len(arguments))))

        return jax.vmap(one)(batched) if side_by_side(devices) else jax.lax.map(one, batched)

    def on_all(*arguments: Any) -> Any:
        specs = tuple(P() if place in whole else P("runs") for place in range(len(arguments)))
        mesh = sharding(devices).mesh
        mapped = jax.shard_map(on_device, mesh=mesh, in_specs=specs, out_specs=P("runs"), check_vma=False)
        return mapped(*arguments)

    # said once more, because arrays without entries, such as a model's activations that has none, come out undivided
    return jax.jit(on_all, donate_argnums=donate, out_shardings=sharding(devices))


def compile_over_devices(function: Callable[[Any], Any], trees: Sequence[Any]) -> tuple[Any, Any]:
    """The compiled program of `function` for all `trees` over all devices, and what to call it with.

    Results have a leading axis of runs: the given ones, and then copies of the last that fill up the devices.
    """
    devices = jax.devices()
    filled = padded(trees, len(trees) + -len(trees) % len(devices))
    runs = jax.device_put(stack(filled), sharding(devices))
    return over_devices(function, devices).lower(runs).compile(), runs
