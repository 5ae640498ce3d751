"""What happens on the road: the study's scene, dry and in the rain, and what can be seen in a drive through it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

import peps_envs
from peps_envs.highway import Highway
from peps_envs.highway.vehicle import LANE_WIDTH
from peps_jax import rollout
from peps_jax.config import Config, Problem
from peps_jax.preferences.data import Segments
from peps_jax.settings import RolloutSettings
from peps_jax.train import Result
from peps_jax.trajectory import Trajectory

DRY, RAIN = "highway-dry", "highway-rain"
HORIZON = Highway.horizon
ONSET = (0.0, 0.4)  # s, when the car in front begins to brake: nobody can count on it and brake before

BEHAVIOURS = ("steers at once", "brakes, then steers", "brakes and stays", "neither")
STEERS, BRAKES_THEN_STEERS, BRAKES, NEITHER = range(len(BEHAVIOURS))


def road(name: str, **changes: Any) -> Config:
    """A `Config` of `DRY`, the regular condition, or of `RAIN`, with the scene of the study on it."""
    task = peps_envs.make(name)
    onset = jnp.asarray(ONSET, jnp.result_type(float))
    begin = lambda params: params.replace(scenario=params.scenario.replace(onset=onset))
    return Config(env=name, params=begin(task.params), belief=begin(task.beliefs["both"]), **changes)


def whole(trajectory: Trajectory) -> Segments:
    """Scenes (n, horizon, ...) from what was collected from their start on, (horizon, n, ...); masked after their end."""
    rows = jax.tree.map(lambda rows: jnp.swapaxes(rows, 0, 1), trajectory)
    over = rows.transition.terminated | rows.truncated
    return Segments(
        observation=rows.transition.observation,
        action=rows.transition.action,
        mask=jnp.cumsum(over, 1) - over == 0,
        reward=rows.transition.reward,
        state=rows.state,
        next_state=rows.next_state,
    )


def whole_scenes(number: int) -> RolloutSettings:
    """Settings of `number` scenes side by side, from start to end."""
    return RolloutSettings(num_envs=number, length=HORIZON, hold_steps=1, exploration=jnp.zeros((), jnp.float32))


def watch(act: Callable[[Array, Array, Array], Array], problem: Problem, key: Array, number: int) -> Segments:
    """`number` scenes of `problem`, whole: (number, horizon, ...), masked after a crash. `act` as in `rollout.collect`."""
    key_start, key_steps = jax.random.split(key)
    settings = whole_scenes(number)
    _, trajectory, _ = rollout.collect(rollout.init(key_start, problem, settings), act, key_steps, problem, settings)
    return whole(trajectory)


def watch_agent(result: Result, key: Array, number: int) -> Segments:
    """`number` scenes of a trained agent, which acts by its policy's mode."""
    return watch(
        lambda observation, key, time: result.policy()(observation, None)[0], result.training.problem, key, number
    )


def crashed(scenes: Segments) -> Array:
    """(...,) bool: whether the ego crashes in what a scene, or a piece of one, shows."""
    return jnp.any(scenes.next_state.vehicles.crashed[..., 0] & scenes.mask, -1)


def behaviour(scenes: Segments) -> Array:
    """(n,) place in `BEHAVIOURS` of each whole scene, by what can be seen: whether it changes lane, and what came before.

    It brakes when it is 2 m/s slower than at the start, and steers when it is 0.5 m off its line, after a policy step each.
    """
    ego = jax.tree.map(lambda rows: rows[..., 0], scenes.next_state.vehicles)
    start = scenes.state.vehicles
    first = lambda happens: jnp.where(jnp.any(happens, 1), jnp.argmax(happens, 1), happens.shape[1])
    seen = scenes.mask
    slower = first((ego.speed < start.speed[:, :1, 0] - 2.0) & seen & ~ego.crashed)
    aside = first((jnp.abs(ego.y - start.y[:, :1, 0]) > 0.5) & seen)
    leaves = jnp.any((jnp.abs(ego.y - start.y[:, :1, 0]) > LANE_WIDTH / 2) & seen, 1)
    stays = jnp.where(slower < seen.shape[1], BRAKES, NEITHER)
    return jnp.where(leaves, jnp.where(slower < aside, BRAKES_THEN_STEERS, STEERS), stays)


def typical(scenes: Segments) -> Segments:
    """The first of `scenes` (n, horizon, ...) that behaves as most of them do: (horizon, ...)."""
    kinds = np.asarray(behaviour(scenes))
    most = np.bincount(kinds, minlength=len(BEHAVIOURS)).argmax()
    return jax.tree.map(lambda rows: rows[int(np.argmax(kinds == most))], scenes)
