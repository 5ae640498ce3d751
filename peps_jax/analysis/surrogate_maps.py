"""What r-hat says over the positions of a navigation domain, beside what the human feels there."""

from __future__ import annotations

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from peps_envs.navigation import Navigation, NavigationState
from peps_jax.config import Config
from peps_jax.learning import surrogate
from peps_jax.preferences import synthetic_human
from peps_jax.train import Result

DIRECTIONS = 16  # of full steps, over which the heat maps take the mean


def surrogate_values(result: Result, resolution: int = 61) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """What r_hat says and what the human feels, over positions: mean over full steps in `DIRECTIONS` directions.

    Returns:
      learned: (resolution, resolution) r_hat, over y and x.
      true: (resolution, resolution) E[l_H(s'|s,a) + r_H(s,a,s')] in the true dynamics.
      free: (resolution, resolution) bool, whether an episode can be at the position and go on.
    """
    config = result.config
    environment, params, belief = config.task()
    ticks = (np.arange(resolution) + 0.5) / resolution
    positions = jnp.asarray(np.stack(np.meshgrid(ticks, ticks), -1).reshape(-1, 2), jnp.float32) * params.size[None]
    angles = 2 * np.pi * np.arange(DIRECTIONS) / DIRECTIONS
    actions = jnp.asarray(np.stack([np.cos(angles), np.sin(angles)], -1), jnp.float32)
    numbers = config.replace(seed=0, params=params, belief=belief)  # leaves of one kind for every cell: one program
    learned, true = _surrogate_values(environment, numbers, result.knowledge.surrogate, positions, actions)
    places, shape = np.asarray(positions), (resolution, resolution)
    within = lambda area: np.all((places >= np.asarray(area)[:2]) & (places <= np.asarray(area)[2:]), -1)
    ended = np.any([within(area) for area in (params.pit, params.goal, *params.walls)], 0)
    return np.asarray(learned).reshape(shape), np.asarray(true).reshape(shape), ~ended.reshape(shape)


@functools.partial(jax.jit, static_argnums=0)
def _surrogate_values(environment: Navigation, config: Config, state: Any, positions: Any, actions: Any) -> Any:
    _, params, belief = config.task()

    def at(position: Any, action: Any) -> tuple[Any, Any]:
        before = NavigationState(position, jnp.zeros((), jnp.int32))
        weights, places = environment.next_state_distribution(before, action, params).quadrature(3)
        after = jax.vmap(lambda place: NavigationState(place, jnp.ones((), jnp.int32)))(places)
        weigh = lambda after: sum(synthetic_human.log_weight(environment, belief, before, action, after))
        learned = surrogate.predict(state, environment.observe(before, params), action, config)
        return learned, weights @ jax.vmap(weigh)(after)

    values = jax.vmap(jax.vmap(at, in_axes=(None, 0)), in_axes=(0, None))(positions, actions)
    return jax.tree.map(lambda value: value.mean(-1), values)


def rank_correlation(a: np.ndarray, b: np.ndarray) -> float:
    """Spearman's, without ties."""
    ranks = [np.argsort(np.argsort(values)) for values in (a, b)]
    return float(np.corrcoef(*ranks)[0, 1])
