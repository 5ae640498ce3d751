"""Environments by name."""

from __future__ import annotations

import difflib
import functools
import importlib
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import jax

from peps_envs import highway, navigation
from peps_envs.environment import Environment


class Task(NamedTuple):
    """An environment with the numbers that make it a task: what is true, and what a human may believe."""

    environment: Environment
    params: Any
    beliefs: dict[str, Any]  # by name; the first one is the default

    @property
    def default_belief(self) -> str:
        return next(iter(self.beliefs))


PHYSICS = ("box", "ice", "reacher")  # modules of `peps_envs.physics`
_TASKS: dict[str, Callable[[], Task]] = {}


def register(name: str, make_task: Callable[[], Task]) -> None:
    """Makes a task available under `name`, for `Config(env=name)` and every command line.

    Raises:
      ValueError: the name is taken.
    """
    if name in _TASKS:
        raise ValueError(f"env {name!r} is registered already; choose another name")
    _TASKS[name] = make_task


def names() -> tuple[str, ...]:
    """The names that `make` knows."""
    return tuple(_TASKS)


def make(name: str) -> Task:
    """The task called `name`.

    Raises:
      ValueError: no such name; the message says the nearest.
    """
    if name not in _TASKS:
        raise ValueError(unknown_name("env", name, _TASKS))
    task = _TASKS[name]()
    return task._replace(beliefs=dict(task.beliefs))  # a dictionary of the caller's own


def unknown_name(field: str, name: str, known: Iterable[str]) -> str:
    """One line for a name that doesn't exist: the field, the value, the nearest right one, and all of them."""
    known = list(known)
    nearest = difflib.get_close_matches(str(name), known, n=1, cutoff=0.4)
    hint = f"did you mean {nearest[0]!r}? " if nearest else ""
    return f"{field} {name!r} is unknown: {hint}known are {', '.join(known)}"


def _once(made: Callable[[], Task]) -> Callable[[], Task]:
    """`made`, called once: many numbers become arrays, which takes a while, and a compiled MuJoCo model equals itself alone."""

    @functools.cache
    def of(double_precision: bool) -> Task:
        del double_precision  # which its parameters are of
        with jax.ensure_compile_time_eval():  # a task may be made while a training is traced
            return made()

    return lambda: of(jax.config.jax_enable_x64)


def _navigation(domain: str) -> Task:
    return Task(navigation.Navigation(), *navigation.domain(domain))


def _highway(domain: str) -> Task:
    return Task(highway.Highway(), *highway.domain(domain))


def _physics(module: str) -> Task:
    # imported when it is asked for, because MuJoCo takes a second
    return Task(*importlib.import_module(f"peps_envs.physics.{module}").domain())


for _domain in navigation.DOMAINS:
    register(f"nav-{_domain}", _once(functools.partial(_navigation, _domain)))
for _domain in highway.DOMAINS:
    register(f"highway-{_domain}", _once(functools.partial(_highway, _domain)))
for _module in PHYSICS:
    register(f"mjx-{_module}", _once(functools.partial(_physics, _module)))
