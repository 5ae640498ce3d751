"""highway-env's own observation and reward."""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array

from peps_envs.highway import vehicle
from peps_envs.highway.vehicle import LANE_WIDTH, LENGTH, MAX_SPEED, Vehicles

ROWS, COLUMNS = 5, 5  # observed vehicles, the ego among them, and features of each
SIGHT = 5 * MAX_SPEED  # m


def observe(vehicles: Vehicles, lanes: int) -> Array:
    """(5, 5): presence, x, y, vx, vy of the ego, absolute, and of the nearest others within 200 m, relative to it.

    Scaled by 200 m, 4 lanes m and 80 m/s and clipped to [-1, 1]. Others further behind than 10 m are not seen.
    """
    features = jnp.stack(
        [
            vehicles.x,
            vehicles.y,
            vehicles.speed * jnp.cos(vehicles.heading),
            vehicles.speed * jnp.sin(vehicles.heading),
        ],
        axis=1,
    )
    ego, others = features[0], features[1:] - features[:1]
    ahead = others[:, 0]
    seen = (ahead**2 + others[:, 1] ** 2 < SIGHT**2) & (ahead > -2 * LENGTH)
    order = jnp.argsort(jnp.where(seen, jnp.abs(ahead), jnp.inf), stable=True)[: ROWS - 1]
    scale = jnp.array([[SIGHT, LANE_WIDTH * lanes, 2 * MAX_SPEED, 2 * MAX_SPEED]], features.dtype)
    rows = jnp.clip(jnp.concatenate([ego[None], others[order]]) / scale, -1, 1)
    presence = jnp.concatenate([jnp.ones(1, bool), seen[order]])[:, None]
    rows = jnp.where(presence, jnp.concatenate([jnp.ones_like(rows[:, :1]), rows], axis=1), 0.0)
    return jnp.pad(rows, ((0, ROWS - rows.shape[0]), (0, 0))).astype(jnp.float32)


def reward(vehicles: Vehicles, lanes: int) -> Array:
    """-1 crashed, 0.1 target_lane / (lanes - 1), 0.4 clip((v cos psi - 20) / 10, 0, 1), from [-1, 0.5] to [0, 1], on the road."""
    x, y = vehicles.x[0], vehicles.y[0]
    fast = jnp.clip((vehicles.speed[0] * jnp.cos(vehicles.heading[0]) - 20) / 10, 0, 1)
    total = 0.4 * fast + 0.1 * vehicles.target_lane[0] / max(lanes - 1, 1) - vehicles.crashed[0]
    return (total + 1) / 1.5 * vehicle.on_lane(x, y, vehicle.closest_lane(x, y, lanes))
