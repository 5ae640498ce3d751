"""What r-hat says over the positions of a navigation domain, beside what the human feels there."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from peps_envs.navigation import Navigation, NavigationState
from peps_jax.config import Problem
from peps_jax.learning import surrogate
from peps_jax.learning.surrogate import SurrogateState
from peps_jax.preferences import synthetic_human
from peps_jax.settings import SurrogateSettings
from peps_jax.train import Result

DIRECTIONS = 16  # of full steps, over which the heat maps take the mean


def has_map(result: Result) -> bool:
    """Whether what was trained lies on a navigation domain's map, over which there is something to see."""
    return isinstance(result.training.problem.environment, Navigation)


def surrogate_values(result: Result, resolution: int = 61) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """What r_hat says and what the human feels, over positions: mean over full steps in `DIRECTIONS` directions.

    Returns:
      learned: (resolution, resolution) r_hat, over y and x.
      true: (resolution, resolution) E[l_H(s'|s,a) + r_H(s,a,s')] in the true dynamics.
      free: (resolution, resolution) bool, whether an episode can be at the position and go on.
    """
    problem = result.training.problem
    params = problem.params
    ticks = (np.arange(resolution) + 0.5) / resolution
    positions = jnp.asarray(np.stack(np.meshgrid(ticks, ticks), -1).reshape(-1, 2), jnp.float32) * params.size[None]
    angles = 2 * np.pi * np.arange(DIRECTIONS) / DIRECTIONS
    actions = jnp.asarray(np.stack([np.cos(angles), np.sin(angles)], -1), jnp.float32)
    settings = result.training.settings.surrogate
    learned, true = _surrogate_values(problem, settings, result.surrogate, positions, actions)
    places, shape = np.asarray(positions), (resolution, resolution)
    within = lambda area: np.all((places >= np.asarray(area)[:2]) & (places <= np.asarray(area)[2:]), -1)
    ended = np.any([within(area) for area in (params.pit, params.goal, *params.walls)], 0)
    return np.asarray(learned).reshape(shape), np.asarray(true).reshape(shape), ~ended.reshape(shape)


@jax.jit
def _surrogate_values(
    problem: Problem, settings: SurrogateSettings, state: SurrogateState, positions: Array, actions: Array
) -> tuple[Array, Array]:
    environment, params, belief = problem.environment, problem.params, problem.belief

    def at(position: Any, action: Any) -> tuple[Any, Any]:
        before = NavigationState(position, jnp.zeros((), jnp.int32))
        weights, places = environment.next_state_distribution(before, action, params).quadrature(3)
        after = jax.vmap(lambda place: NavigationState(place, jnp.ones((), jnp.int32)))(places)
        weigh = lambda after: sum(synthetic_human.log_weight(environment, belief, before, action, after))
        reward = weights @ jax.vmap(lambda after: environment.reward(before, action, after, params))(after)
        learned = surrogate.predict(state, environment.observe(before, params), action, reward, settings)
        return learned, weights @ jax.vmap(weigh)(after)

    values = jax.vmap(jax.vmap(at, in_axes=(None, 0)), in_axes=(0, None))(positions, actions)
    return jax.tree.map(lambda value: value.mean(-1), values)


def rank_correlation(a: np.ndarray, b: np.ndarray) -> float:
    """Spearman's; equal values share a rank. nan where all values of one are equal."""
    if np.ptp(a) == 0 or np.ptp(b) == 0:
        return float("nan")
    from scipy import stats  # takes long to import

    return float(stats.spearmanr(a, b).statistic)
