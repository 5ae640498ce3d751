"""What the researcher's page shows of a training under way: the agent's latest route and r-hat's map, or a scene as a strip."""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING

import jax
import numpy as np
from jax import Array

from peps_envs.navigation import Navigation
from peps_jax import generator, rollout
from peps_jax.analysis.surrogate_maps import surrogate_values
from peps_jax.config import Problem
from peps_jax.drawing import scenes as drawing
from peps_jax.drawing.navigation_map import draw_heat, draw_map, draw_route, draw_start
from peps_jax.drawing.panels import INK, panels_of
from peps_jax.preferences.data import Segments
from peps_jax.reproduce.driving.scenes import whole
from peps_jax.settings import AgentSettings, RolloutSettings
from peps_jax.train import Result, policy_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MOMENTS = 5  # of a strip
SIZE = 4.2  # inches, of a map


def watch(result: Result, key: Array, number: int) -> Segments:
    """`number` scenes of an agent that acts by its policy's mode, whole: (number, horizon, ...), masked after their end."""
    return _watch(result.agents, result.training.problem, result.training.settings.agent, key, number)


@functools.partial(jax.jit, static_argnames="number")
def _watch(agents: tuple, problem: Problem, settings: AgentSettings, key: Array, number: int) -> Segments:
    key_start, key_steps = jax.random.split(key)
    alone = RolloutSettings(number, problem.environment.horizon, hold_steps=1, exploration=np.float32(0))
    act = lambda observation, key, time: policy_of(agents, settings)(observation, None)[0]
    actors = rollout.init(key_start, problem, alone)
    return whole(rollout.collect(actors, act, key_steps, problem, alone)[1])


def draw(result: Result, note: str) -> tuple[Figure, Segments]:
    """What the agent does now, and where positions can be mapped what r-hat has learned so far; and the scene that is shown."""
    scene = jax.tree.map(lambda rows: np.asarray(rows)[0], watch(result, generator.key(result.config.seed), 1))
    if isinstance(result.training.problem.environment, Navigation):
        return _maps(result, scene, note), scene
    problem = result.training.problem
    states = drawing.states_of(scene)
    times = np.linspace(0, int(np.sum(scene.mask)), MOMENTS)
    clip = drawing.scenes_of(problem.environment, problem.params, states, times)
    return drawing.strips({"the agent now": clip}, [f"step {time:g}" for time in times], note), scene


def _maps(result: Result, scene: Segments, note: str) -> Figure:
    params = result.training.problem.params
    figure, ((routes, heat),) = panels_of(1, 2, SIZE, SIZE)
    draw_map(routes, params)
    draw_route(routes, drawing.states_of(scene).position, result.config.method, alpha=1.0, width=1.8)
    draw_start(routes, params)
    learned, _, free = surrogate_values(result)
    draw_heat(figure, heat, np.where(free, learned, np.nan), params)
    for axes, title in ((routes, "the agent's route now"), (heat, "r̂, learned from the answers so far")):
        axes.set_title(title, color=INK, fontsize=10)
    figure.supxlabel(note, color=INK, fontsize=9)
    return figure
