"""Areas, walls, and how a point moves between them. An area is (x0, y0, x1, y1), closed, in arena units."""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array

from peps_envs.navigation.parameters import NavigationParams

SLACK = 1e-4  # arena units: a position that was read back from an observation may lie off a face or an edge


def inside(position: Array, area: Array) -> Array:
    """Whether `position` (2,) lies in the closed `area` (4,)."""
    return jnp.all((position >= area[:2]) & (position <= area[2:]))


def distance(position: Array, area: Array) -> Array:
    """Euclidean distance from `position` (2,) to `area` (4,), 0 inside."""
    return root(jnp.sum(jnp.maximum(jnp.maximum(area[:2] - position, position - area[2:]), 0.0) ** 2))


def root(squared: Array) -> Array:
    """The square root of `squared` >= 0, with derivative 0 at 0, where it is infinite."""
    return jnp.where(squared > 0, jnp.sqrt(jnp.where(squared > 0, squared, 1.0)), 0.0)


def free_interval(position: Array, axis: int, params: NavigationParams) -> tuple[Array, Array]:
    """How far a point may move along `axis` from `position` (2,) until a wall or the arena's edge stops it: (low, high)."""
    other = 1 - axis
    walls = params.walls
    # a point on a wall's face may slide along it
    in_the_way = (walls[:, other] + SLACK < position[other]) & (position[other] < walls[:, 2 + other] - SLACK)
    before = in_the_way & (walls[:, 2 + axis] <= position[axis] + SLACK)
    after = in_the_way & (walls[:, axis] >= position[axis] - SLACK)
    low = jnp.max(jnp.where(before, walls[:, 2 + axis], 0.0), initial=0.0)
    high = jnp.min(jnp.where(after, walls[:, axis], params.size[axis]), initial=jnp.inf)
    return low, jnp.minimum(high, params.size[axis])


def walk(position: Array, target: Array, params: NavigationParams) -> Array:
    """Where a movement from `position` (2,) to `target` (2,) ends: x first, then y in the new column, each stopped by walls."""
    x = jnp.clip(target[0], *free_interval(position, 0, params))
    y = jnp.clip(target[1], *free_interval(jnp.array([x, position[1]]), 1, params))
    return jnp.array([x, y])
