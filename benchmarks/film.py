"""The README's picture: what a human expects, what PEPS does and what SAC does in D4, side by side.

    make film

Trains both methods and the human's expectation with the default settings and one seed, and writes `docs/film.gif`.
"""

from __future__ import annotations

import argparse
import dataclasses
from collections.abc import Sequence
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import peps_envs
from peps_envs import Scene
from peps_envs.navigation import NavigationState
from peps_envs.scene import Polyline, Text
from peps_jax import Config, Evaluation, evaluate, train
from peps_jax.drawing.panels import colour_of
from peps_jax.drawing.scenes import scenes_of, small_film

ROOT = Path(__file__).parents[1]
ENV = "nav-d4"
TITLES = {"human_expectation": "what the human expects", "peps": "PEPS", "sac": "SAC"}
NAMES = {"goal": "goal", "pit": "pit", "ice": "ice", "firm sand": "sand"}  # written on the areas of the first moment
FRAMES_PER_STEP, RATE = 3, 9  # moments of a step, and of a second
REST = 12  # moments that the end stands still
WIDTH = 2.4  # inches, of one clip


def labelled(scene: Scene) -> Scene:
    """`scene` with the names of its areas on them, below the agent."""
    *areas, agent = scene.shapes
    names = [Text(area.x, area.y, NAMES[area.colour]) for area in areas if area.colour in NAMES]
    return dataclasses.replace(scene, shapes=(*areas, *names, agent))


def route_clip(method: str, evaluation: Evaluation) -> list[Scene]:
    """The first episode of `evaluation`, moment by moment, with the way that was walked so far as a line."""
    task = peps_envs.make(ENV)
    steps = int(evaluation.length[0])
    places = np.asarray(evaluation.perceived[0][: steps + 1])
    states = NavigationState(places, jnp.arange(steps + 1))
    times = np.arange(steps * FRAMES_PER_STEP + 1) / FRAMES_PER_STEP
    clip, colour = [], colour_of(method)
    for time, scene in zip(times, scenes_of(task.environment, task.params, states, times), strict=True):
        *areas, agent = labelled(scene).shapes
        way = [*map(tuple, places[: int(time) + 1]), (agent.x, agent.y)]
        agent = dataclasses.replace(agent, colour=colour)
        clip.append(dataclasses.replace(scene, shapes=(*areas, Polyline(tuple(way), colour), agent)))
    return clip


def clips(config: Config) -> dict[str, Sequence[Scene]]:
    """A clip of each method by its title, which says how it scored."""
    made = {}
    for method, title in TITLES.items():
        own = config.replace(method=method)
        result = jax.jit(train)(own)
        evaluation = evaluate(result, 1)
        score = f"return {float(evaluation.return_[0]):.0f}, explicability {float(evaluation.explicability[0]):.0f}"
        made[title if method == "human_expectation" else f"{title}: {score}"] = route_clip(method, evaluation)
    return made


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--steps", type=int, default=Config().total_steps, help="environment steps of a training")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=ROOT / "docs" / "film.gif")
    given = parser.parse_args(arguments)
    made = clips(Config(env=ENV, seed=given.seed, total_steps=given.steps))
    small_film(made, given.out, RATE, len(made), WIDTH, REST)


if __name__ == "__main__":
    main()
