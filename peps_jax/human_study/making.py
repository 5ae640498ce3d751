"""Makes a study: its folder, its file of settings and texts, its database with the pairs that people will see."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax

from peps_jax.config import Problem
from peps_jax.human_study import clips, orders, pairs, settings, tokens
from peps_jax.human_study.database import Database
from peps_jax.human_study.orders import AGREEING
from peps_jax.human_study.settings import Folder, Settings
from peps_jax.preferences.data import Segments
from peps_jax.storage import code, files

PRACTICE = 2  # pairs that nobody's answer to is kept of


def check(folder: Folder, env: str, test_env: str, numbers: dict[str, Any]) -> Settings:
    """The settings of a study that can be made. Raises ValueError, in one line, if it can't."""
    folder.check_free()
    for name in (env, test_env):
        task = pairs.problem(name)
        clips.view(task.environment, task.params)  # raises of what can't be drawn
    return settings.read(_content(env, test_env, numbers))


def _content(env: str, test_env: str, numbers: dict[str, Any]) -> str:
    roads = pairs.is_road(env) and pairs.is_road(test_env)
    return settings.template(env, test_env, roads, _roles(pairs.problem(env)), **numbers)


def _roles(task: Problem) -> list[str]:
    """Of what there is to see in an environment."""
    state, _ = task.environment.reset(jax.random.key(0), task.params)
    return sorted({shape.colour for shape in task.environment.scene(jax.device_get(state), task.params).shapes})


def make(folder: Folder, env: str, test_env: str, numbers: dict[str, Any], with_pairs: bool = True) -> Settings:
    """Makes a study; returns its settings.

    Args:
      numbers: settings that aren't the defaults, by their names in the file.
      with_pairs: whether it has pairs of its own; otherwise a training asks.

    Raises:
      ValueError: it can't be made; one line says why.
      NotWrittenError: there is no room, or no permission.
    """
    made = check(folder, env, test_env, numbers)
    files.make_folder(folder.path)
    tokens.make_key(folder.key)
    files.write_with(folder.database, lambda path: _fill(path, made, with_pairs))
    files.write_whole(folder.file, _content(env, test_env, numbers).encode())
    return made


def _fill(path: Path, made: Settings, with_pairs: bool) -> None:
    database = Database.create(path)
    task, test_task = pairs.problem(made.env), pairs.problem(made.test_env)
    database.note("view", clips.view(task.environment, task.params))
    database.note("test_view", clips.view(test_task.environment, test_task.params))
    fixed = {name: getattr(made, name) for name in settings.FIXED}
    database.note("made", fixed | {"code": code.digest("peps_jax.human_study.pairs")})
    if with_pairs:
        checks = pairs.to_check(made.env, made.seed, made.checks)
        _add(database, "check", task, checks)
        single, shared = orders.pool(made.participants, asked(made, 0 if checks is None else made.checks), made.shared)
        shown = pairs.to_ask(made.env, made.seed, single + shared + PRACTICE)
        practice = jax.tree.map(lambda rows: rows[:PRACTICE], shown)
        ask = jax.tree.map(lambda rows: rows[PRACTICE:], shown)
        _add(database, "practice", task, practice)
        _add(database, "ask", task, ask, [1] * single + [AGREEING] * shared)
    database.close()


def asked(made: Settings, checks: int) -> int:
    """How many pairs one participant sees that are neither repeats nor checks."""
    return made.pairs - round(made.pairs * made.repeats) - checks


def _add(
    database: Database, kind: str, task: Problem, segments: Segments | None, people: Sequence[int] | None = None
) -> None:
    if segments is not None:
        database.add_queries(kind, pairs.pairs_of(task, segments), people)
