"""Physics in which people's beliefs are wrong in ways that have been measured: tasks on small MuJoCo models, stepped by MJX.

A module for each, with its models' XML and

    MISJUDGED      what people misjudge, in words with its unit; what it is; and what they take it for, such as
                   ("mass of the box, kg", 5.0, 1.0)
    model(value)   MuJoCo's model in which it is so much, compiled; the true one by default
    domain()       the environment, its true parameters, and beliefs by name, of which the first one is the default

The registry names them (`PHYSICS`) and imports one when its task is made, because MuJoCo and MJX take a second.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from typing import Any, NamedTuple

from peps_envs import registry


class Misjudged(NamedTuple):
    """What the human of a task is wrong about."""

    words: str  # with its unit
    true: float
    believed: float  # by the task's default belief
    belief: Callable[[float], Any]  # that it is so much, as parameters of the task's environment


def misjudged(task: str) -> Misjudged:
    """What the human of `task` ("mjx-box") is wrong about."""
    module = importlib.import_module(f"{__name__}.{task.removeprefix('mjx-')}")
    environment = registry.make(task).environment
    return Misjudged(*module.MISJUDGED, lambda value: environment.model(module.model(value)))
