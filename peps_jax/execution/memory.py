"""Memory: what a traced program will need, predicted before it is compiled, and what the machine has.

Knows nothing of trainings: `peps_jax.execution.batches` asks it about theirs.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
import psutil

# of the free memory that a batch may plan with: the prediction doesn't know what other programs take
AVAILABLE_SHARE = 0.8
# operations that write their result over an argument of its size which nobody needs any more; small functions such as an
# activation are calls
IN_PLACE = {
    "jit", "pjit", "custom_jvp_call", "add", "sub", "mul", "div", "rem", "neg", "abs", "sign", "max", "min",
    "clamp", "and", "or", "not", "xor", "eq", "ne", "lt", "le", "gt", "ge", "select_n", "exp", "log", "log1p",
    "expm1", "tanh", "logistic", "sin", "cos", "sqrt", "rsqrt", "pow", "integer_pow", "square", "floor", "ceil",
    "round", "erf", "erf_inv", "is_finite", "copy", "convert_element_type", "reshape", "squeeze", "expand_dims",
    "dynamic_update_slice",
}  # fmt: skip


class Need(NamedTuple):
    """Predicted bytes of one run."""

    state: int  # what a training carries from round to round
    working: int  # what a round, or the evaluation, has in use beside it at most


class OutOfMemoryError(ValueError):
    """Not even one run fits."""


def size_of(value: Any) -> int:
    """Bytes of an array, or of the shape of one."""
    return int(np.prod(value.shape, dtype=object)) * value.dtype.itemsize


def most_in_use(program: Any) -> int:
    """Bytes of the values that `program` (a jaxpr) has in use at the same time at most, its inputs not counted."""
    last = {value: place for place, step in enumerate(program.eqns) for value in step.invars if _is_variable(value)}
    last |= {value: len(program.eqns) for value in program.outvars if _is_variable(value)}
    made: set[Any] = set()
    in_use = most = 0
    for place, step in enumerate(program.eqns):
        inside = max((most_in_use(part) for part in _parts(step)), default=0)
        over = {
            value for value in (*step.invars, *step.outvars) if _is_variable(value) and last.get(value, -1) <= place
        }
        new = sum(size_of(value.aval) for value in step.outvars)
        if step.primitive.name in IN_PLACE:
            same = next((value for value in over & made if size_of(value.aval) == new), None)
            if same is not None:
                in_use -= new
                made.remove(same)
        in_use += new
        most = max(most, in_use + inside)
        made.update(step.outvars)
        in_use -= sum(size_of(value.aval) for value in over & made)
        made -= over
    return most


def _is_variable(value: Any) -> bool:
    return not hasattr(value, "val")  # a literal has a value


def _parts(step: Any) -> Iterator[Any]:
    """The programs inside one operation: a scan's body, a branch, a jitted function."""
    for parameter in step.params.values():
        for part in parameter if isinstance(parameter, tuple | list) else (parameter,):
            part = getattr(part, "jaxpr", part)
            if hasattr(part, "eqns"):
                yield part


def available_bytes(devices: Sequence[jax.Device]) -> int:
    """Free memory for each of `devices`: the accelerator's own, or a CPU device's share of the machine's."""
    statistics = [device.memory_stats() or {} for device in devices]
    if all("bytes_limit" in figures for figures in statistics):
        return min(figures["bytes_limit"] - figures.get("bytes_in_use", 0) for figures in statistics)
    return min(psutil.virtual_memory().available, _container_bytes()) // len(devices)


def _container_bytes() -> float:
    """What a container's limit leaves; infinite without one. The system's own figure doesn't know of it."""
    folder = Path("/sys/fs/cgroup")
    try:
        limit, used = ((folder / name).read_text(encoding="utf-8").strip() for name in ("memory.max", "memory.current"))
        return float("inf") if limit == "max" else int(limit) - int(used)
    except (OSError, ValueError):
        return float("inf")


def runs_that_fit(need: Need, free: int, together: bool) -> int:
    """How many runs fit on a device: the largest k whose `bytes_needed` are at most AVAILABLE_SHARE * free."""
    free = int(AVAILABLE_SHARE * free)
    each = bytes_needed(need, 2, together) - bytes_needed(need, 1, together)
    return max(0, free - bytes_needed(need, 0, together)) // each


def bytes_needed(need: Need, runs: int, together: bool) -> int:
    """Bytes of a device that has `runs` runs.

    The state counts twice, because new states are written beside the old ones. Runs that are worked on `together` all need
    their working memory; one after the other they need it once, and a copy of the state that is worked on.
    """
    if together:
        return runs * (2 * need.state + need.working)
    return (2 * runs + 1) * need.state + need.working


def readable(number: float) -> str:
    for unit in ("B", "kB", "MB", "GB"):
        if number < 1000:
            return f"{number:.3g} {unit}"
        number /= 1000
    return f"{number:,.0f} TB"
