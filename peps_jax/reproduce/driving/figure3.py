"""Figure 3: the driving study. What each of its programs trained is kept, so that a stopped command continues."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import jax
import numpy as np

from peps_jax.config import Config
from peps_jax.reproduce.driving import experiment, report
from peps_jax.reproduce.driving.experiment import Part, Seen
from peps_jax.reproduce.store import CELLS, digest, settings_of
from peps_jax.reproduce.trainings import Study
from peps_jax.storage import code, files
from peps_jax.storage.arrays import read_arrays, write_arrays

CODE = "peps_jax.reproduce.driving.experiment"  # whose code, and that of all it imports, decides the numbers beside the settings


def figure3_needs(made: Study) -> list:
    """None of the trainings that tables and figures share."""
    del made
    return []


def figure3(made: Study, folder: Path) -> list[Path]:
    """figure3.{md,json,png,gif}: behaviours, crashes and ratings of every method, and PEPS over lambda."""
    return report.write(experiment.run(_parts(made), make=lambda part: _make(part, folder)), folder)


def check(made: Study, folder: Path) -> None:
    """Raises ValueError if a file of `folder` can't be read, or something else than this study made it."""
    for part in _parts(made):
        if _path(part, folder).exists():
            _leaves(part, folder)


def _parts(made: Study) -> list[Part]:
    own = made.base.total_steps == Config().total_steps  # a length that was asked for is the study's too
    return experiment.parts(range(made.seeds), experiment.STEPS if own else made.base.total_steps)


def _path(part: Part, folder: Path) -> Path:
    return folder / CELLS / f"driving-{part.name.replace(' ', '-')}-{len(part.seeds)}-seeds.npz"


def _digest(part: Part) -> str:
    return digest([_recipe(config) for config in part.configs], part.episodes, code.digest(CODE))


def _recipe(config: Config) -> dict[str, Any]:
    """Every setting, as JSON knows it; road and belief by their numbers."""
    numbers = [np.asarray(leaf).tolist() for leaf in jax.tree.leaves((config.params, config.belief))]
    return settings_of(config.replace(params=None, belief=None)) | {"numbers": files.plain(numbers)}


def _leaves(part: Part, folder: Path) -> list[np.ndarray]:
    arrays = read_arrays(_path(part, folder), _digest(part), "settings or code")
    return [arrays[str(place)] for place in range(len(arrays))]


def _make(part: Part, folder: Path) -> Seen:
    """What `part`'s agents were seen to do: from its file, or trained now and kept in it."""
    path = _path(part, folder)
    if path.exists():
        like = jax.eval_shape(lambda config: experiment.learn(config, part.episodes), part.configs[0])
        return jax.tree.unflatten(jax.tree.structure(like), _leaves(part, folder))
    seen = experiment.run_part(part)
    files.make_folder(path.parent)
    write_arrays(path, _digest(part), {str(place): leaf for place, leaf in enumerate(jax.tree.leaves(seen))})
    return seen
