"""The known-model planner: value iteration on a grid of positions, for environments whose state is a position in a rectangle.

It knows the dynamics, the belief and the rewards that a training has to learn, so what it reaches is the yardstick:

    "return"  r_A in the true dynamics: the best task performance,
    "human"   r_H in the believed dynamics: what the human would do,
    "peps"    r_A + lambda (r_H + l_H + H_T) in the true dynamics: Eq. (6) with the surrogate reward as it should be.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from peps_envs.navigation import Navigation, NavigationParams, NavigationState, inside
from peps_envs.registry import unknown_name
from peps_jax.config import Problem
from peps_jax.evaluate import Evaluation, Policy, evaluate_policy

OBJECTIVES = ("return", "human", "peps")


class Plan(NamedTuple):
    """A solved objective."""

    values: Array  # (rows, columns) on the grid, over y and x
    residual: Array  # () the last sweep's largest change
    policy: Policy  # greedy, one exact step ahead of the grid's values


def _actions(directions: int, full_action: Array) -> Array:
    """Full and half steps in `directions` directions, and standing still: (2 * directions + 1, 2)."""
    angles = 2 * np.pi * np.arange(directions) / directions
    full = np.stack([np.cos(angles), np.sin(angles)], -1)
    return full_action * jnp.asarray(np.concatenate([full, full / 2, np.zeros((1, 2))]), jnp.float32)


def _corners(position: Array, resolution: int, size: Array) -> tuple[Array, Array]:
    """Bilinear interpolation on the flattened grid: the four nodes around `position` and their weights, (4,) each."""
    place = jnp.clip(position / size, 0, 1) * (resolution - 1)
    corner = jnp.clip(jnp.floor(place).astype(jnp.int32), 0, resolution - 2)
    x, y = corner
    fx, fy = place - corner
    index = jnp.array([0, 1, resolution, resolution + 1]) + y * resolution + x
    return index, jnp.array([(1 - fx) * (1 - fy), fx * (1 - fy), (1 - fx) * fy, fx * fy])


def solve(
    params: NavigationParams,
    belief: NavigationParams,
    objective: str = "return",
    lam: float | Array = 2.4,
    *,
    gamma: float = 0.995,
    resolution: int = 121,
    directions: int = 24,
    points: int = 1,
    tolerance: float = 1e-3,
) -> Plan:
    """Value iteration for one of `OBJECTIVES`.

    Args:
      params: the true domain.
      belief: the human's.
      objective: whose reward, in whose dynamics; see the module's text.
      lam: the reconciliation parameter, for "peps".
      gamma: discount.
      resolution: grid points along each side.
      directions: directions of movement that are tried, with full and half steps.
      points: quadrature points an axis of the displacement's noise; 1 is exact where the dynamics acted in have none.
      tolerance: values are improved until none changes by more.

    Raises:
      ValueError: an unknown objective.
    """
    if objective not in OBJECTIVES:
        raise ValueError(unknown_name("objective", objective, OBJECTIVES))
    environment = Navigation()
    acting = belief if objective == "human" else params
    actions = _actions(directions, params.full_action)
    gain = functools.partial(_gain, environment, params, belief, objective, lam)

    def consequences(position: Array, action: Array) -> tuple[Array, Array, Array]:
        """The expected reward, and the grid's nodes that follow with their discounted weights, (n,) each."""
        state = NavigationState(position, jnp.zeros((), jnp.int32))
        after = environment.next_state_distribution(state, action, acting)
        weights, positions = after.quadrature(points)
        reward = weights @ jax.vmap(lambda position: gain(state, action, position))(positions)
        if objective == "peps":
            reward += lam * after.relative_entropy()
        ended = jax.vmap(lambda position: inside(position, acting.goal) | inside(position, acting.pit))(positions)
        index, share = jax.vmap(_corners, in_axes=(0, None, None))(positions, resolution, params.size)
        return reward, index.reshape(-1), (gamma * (weights * ~ended)[:, None] * share).reshape(-1)

    every_action = jax.vmap(consequences, in_axes=(None, 0))
    values, residual = _iterate(lambda node: every_action(node, actions), params.size, resolution, tolerance)

    def policy(observation: Array, key: Array | None) -> tuple[Array, Any]:
        del key  # deterministic
        position = environment.position_of(observation, params)
        rewards, index, weights = every_action(position, actions)
        return actions[jnp.argmax(rewards + jnp.sum(weights * values[index], -1))], jnp.zeros(())

    return Plan(values=values.reshape(resolution, resolution), residual=residual, policy=policy)


def _gain(
    environment: Navigation,
    params: NavigationParams,
    belief: NavigationParams,
    objective: str,
    lam: float | Array,
    state: NavigationState,
    action: Array,
    position: Array,
) -> Array:
    """What a step to `position` is worth, but for the environment entropy."""
    after = NavigationState(position, state.time + 1)
    if objective == "human":
        return environment.reward(state, action, after, belief)
    reward = environment.reward(state, action, after, params)
    if objective == "return":
        return reward
    expected = environment.next_state_distribution(state, action, belief).relative_log_prob(position)
    return reward + lam * (environment.reward(state, action, after, belief) + expected)


def _iterate(
    every_action: Callable[[Array], tuple[Array, Array, Array]], size: Array, resolution: int, tolerance: float
) -> tuple[Array, Array]:
    """Value iteration over the grid: its values (resolution^2,), and the last sweep's largest change.

    Args:
      every_action: a node's position -> of every action the expected reward, and the nodes that follow with their weights.
    """
    ticks = np.linspace(0, 1, resolution)
    nodes = jnp.asarray(np.stack(np.meshgrid(ticks, ticks), -1).reshape(-1, 2), jnp.float32) * size[None]
    # row by row: no remainder, which would be a program of its own
    rewards, index, weights = jax.lax.map(every_action, nodes, batch_size=resolution)

    def sweep(carry: tuple[Array, Array]) -> tuple[Array, Array]:
        values, _ = carry
        improved = jnp.max(rewards + jnp.sum(weights * values[index], -1), -1)
        return improved, jnp.max(jnp.abs(improved - values))

    return jax.lax.while_loop(lambda carry: carry[1] > tolerance, sweep, (jnp.zeros(resolution**2), jnp.inf))


def walk(
    environment: Navigation,
    params: NavigationParams,
    belief: NavigationParams,
    objective: str,
    lam: float | Array,
    num_episodes: int,
    **how: Any,
) -> Evaluation:
    """Episodes of the plan for `objective`, in the dynamics that it is made for; `how` as `solve` takes it."""
    plan = solve(params, belief, objective, lam, **how)
    acting = belief if objective == "human" else params
    return evaluate_policy(plan.policy, Problem(environment, acting, belief), jax.random.key(0), num_episodes)
