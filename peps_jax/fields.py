"""Fields of `Config`: help text, group and what values make sense, kept as the field's metadata, and the checks of it."""

from __future__ import annotations

import dataclasses
import numbers
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np
from flax import struct

from peps_envs.registry import unknown_name

MOST = 2**31 - 1  # of whole numbers: sizes and seeds are 32-bit


class Range(NamedTuple):
    """What values of a setting make sense, as a test of one value and as words."""

    holds: Callable[[Any], Any]
    words: str


NOT_NEGATIVE = Range(lambda value: (value >= 0) & np.isfinite(value), "0 or more")
POSITIVE = Range(lambda value: (value > 0) & np.isfinite(value), "above 0")
SHARE = Range(lambda value: (value >= 0) & (value <= 1), "from 0 to 1")
COUNT = Range(lambda value: (value >= 1) & (value <= MOST), f"a whole number from 1 to {MOST}")
COUNT_OR_NONE = Range(lambda value: (value >= 0) & (value <= MOST), f"a whole number from 0 to {MOST}")
SIZES = Range(lambda value: COUNT.holds(value), f"one or more sizes, whole numbers from 1 to {MOST}")
FLOOR = Range(lambda value: value < np.inf, "a number, or -inf for none")
CEILING = Range(lambda value: value > 0, "above 0, or inf for none")
LESS_THAN_ALL = Range(lambda value: (value >= 0) & (value < 1), "from 0 to below 1")
SWITCH = Range(lambda value: value is True or value is False, "True or False")


def _one_of(choices: tuple[str, ...]) -> Range:
    return Range(lambda value: value in choices, ", ".join(choices))


def static(default: Any, valid: Range | tuple[str, ...] | None, text: str, **metadata: Any) -> Any:
    """A field that changes shapes or program structure: what makes sense, or the choices there are, and its help text."""
    choices = valid if isinstance(valid, tuple) and not isinstance(valid, Range) else None
    valid = valid if choices is None else _one_of(choices)
    metadata |= {"help": text, "range": valid, "choices": choices}
    return struct.field(pytree_node=False, default=default, metadata=metadata)


def traced(default: Any, valid: Range | None, text: str, **metadata: Any) -> Any:
    """A field whose value is a leaf of the pytree."""
    return struct.field(default=default, metadata={"help": text, "range": valid, "choices": None, **metadata})


def check_value(field: dataclasses.Field, value: Any) -> None:
    """Raises ValueError if a concrete value of `field`, or any of a batch of them, makes no sense."""
    valid, default = field.metadata.get("range"), field.default
    if valid is None or isinstance(value, jax.core.Tracer):
        return
    try:
        good = _is_kind(value, default) and bool(np.all(valid.holds(_comparable(value, default))))
    except (TypeError, ValueError, OverflowError):
        good = False
    if good:
        return
    if field.metadata["choices"] is not None:
        raise ValueError(unknown_name(field.name, value, field.metadata["choices"]))
    raise ValueError(f"{field.name} {shown(value)} is out of range: choose {valid.words}")


def _is_kind(value: Any, default: Any) -> bool:
    """Whether `value` is of the kind of `default`: True is no number, 2.5 no whole number."""
    if isinstance(default, bool | str):
        return isinstance(value, type(default))
    if isinstance(default, tuple):
        return isinstance(value, tuple | list) and len(value) > 0 and all(_is_kind(one, default[0]) for one in value)
    kind = numbers.Integral if isinstance(default, int) else numbers.Real
    if isinstance(value, np.ndarray | np.generic | jax.Array):
        return np.issubdtype(value.dtype, np.integer if kind is numbers.Integral else np.number)
    return isinstance(value, kind) and not isinstance(value, bool)


def _comparable(value: Any, default: Any) -> Any:
    return value if isinstance(default, bool | str) or isinstance(value, int) else np.asarray(value)


def check_single(field: dataclasses.Field, value: Any) -> None:
    """Raises ValueError for a batch where one training's value belongs."""
    if field.name not in ("params", "belief") and np.shape(value):
        raise ValueError(
            f"{field.name} has shape {np.shape(value)}: a training takes one value; use jax.vmap(train) for a batch of them"
        )


def shown(value: Any) -> str:
    """A value as a message shows it, in one line that is not too long."""
    text = " ".join(repr(value).split())
    return text if len(text) <= 60 else f"{text[:57]}..."
