"""Collisions of rectangles, by separating axes, now and within the coming simulation step."""

from __future__ import annotations

import math

import jax.numpy as jnp
import numpy as np
from jax import Array

from peps_envs.highway.vehicle import LENGTH, WIDTH, Vehicles

_DIAGONAL = math.hypot(LENGTH, WIDTH)  # m


def _distance(low_a: Array, high_a: Array, low_b: Array, high_b: Array) -> Array:
    """Distance of two intervals, negative where they overlap."""
    return jnp.where(low_a < low_b, low_b - high_a, low_a - high_b)


def meet(
    offset: tuple[Array, Array],
    direction: tuple[Array, Array],
    other: tuple[Array, Array],
    shift: tuple[Array, Array],
    contact: Array,
) -> tuple[Array, Array, Array, Array]:
    """Whether two cars intersect, whether they will in this step, and the smallest translation that would part them.

    Args:
      offset: from the first car's centre to the other's, m.
      direction: unit vector along the first car.
      other: unit vector along the other car.
      shift: how the first car moves relative to the other in the step, m.
      contact: () m, the gap up to which they intersect.

    Returns:
      intersects, will intersect, translation of the first car along x and y.
    """
    cosine = jnp.abs(direction[0] * other[0] + direction[1] * other[1])
    sine = jnp.abs(direction[0] * other[1] - direction[1] * other[0])
    along = LENGTH / 2 * cosine + WIDTH / 2 * sine  # half of one car's extent along the other's axis
    across = LENGTH / 2 * sine + WIDTH / 2 * cosine
    normals = []  # the edges' normals in the order of highway-env's polygons: at a tie the first one counts
    for ahead, aside in (direction, other):
        normals += [(-ahead, -aside), (-aside, ahead), (ahead, aside), (aside, -ahead)]
    extents = [(LENGTH / 2, along), (WIDTH / 2, across)] * 2 + [(along, LENGTH / 2), (across, WIDTH / 2)] * 2

    intersects = will_intersect = jnp.ones_like(cosine, bool)
    smallest = jnp.full_like(cosine, jnp.inf)
    push_x = push_y = jnp.zeros_like(cosine)
    for (normal_x, normal_y), (extent, other_extent) in zip(normals, extents, strict=True):
        centre = normal_x * offset[0] + normal_y * offset[1]
        moved = normal_x * shift[0] + normal_y * shift[1]
        low, high = centre - other_extent, centre + other_extent
        intersects &= _distance(-extent, extent, low, high) <= contact
        distance = _distance(-extent + jnp.minimum(moved, 0), extent + jnp.maximum(moved, 0), low, high)
        will_intersect &= distance <= contact
        nearer = jnp.abs(distance) < smallest
        smallest = jnp.where(nearer, jnp.abs(distance), smallest)
        away = jnp.where(centre < 0, smallest, -smallest)
        push_x = jnp.where(nearer, away * normal_x, push_x)
        push_y = jnp.where(nearer, away * normal_y, push_y)
    return intersects, will_intersect, push_x, push_y


def collide(vehicles: Vehicles, dt: float, contact: Array) -> Vehicles:
    """Tests all pairs i < j. Who intersects has crashed; who will intersect is displaced in the next step, by half each."""
    number = vehicles.x.shape[0]
    none = vehicles.replace(
        impact_x=jnp.zeros_like(vehicles.x),
        impact_y=jnp.zeros_like(vehicles.x),
        struck=jnp.zeros_like(vehicles.struck),
    )
    if number == 1:
        return none
    first, second = np.triu_indices(number, 1)
    ahead, aside = jnp.cos(vehicles.heading), jnp.sin(vehicles.heading)
    move_x, move_y = vehicles.speed * ahead * dt, vehicles.speed * aside * dt
    offset = (vehicles.x[second] - vehicles.x[first], vehicles.y[second] - vehicles.y[first])
    near = offset[0] ** 2 + offset[1] ** 2 <= jnp.maximum(_DIAGONAL + vehicles.speed[first] * dt, 0) ** 2
    intersects, will_intersect, push_x, push_y = meet(
        offset,
        (ahead[first], aside[first]),
        (ahead[second], aside[second]),
        (move_x[first] - move_x[second], move_y[first] - move_y[second]),
        contact,
    )
    intersects, will_intersect = intersects & near, will_intersect & near

    # the last pair's impact overwrites earlier ones, and for every car the pairs come in the order of its partners
    columns = {"crashed": [], "struck": [], "impact_x": [], "impact_y": []}
    for car in range(number):
        crashed, struck, impact_x, impact_y = vehicles.crashed[car], False, 0.0, 0.0
        for pair in np.flatnonzero((first == car) | (second == car)):
            half = 0.5 if first[pair] == car else -0.5
            crashed |= intersects[pair]
            struck |= will_intersect[pair]
            impact_x = jnp.where(will_intersect[pair], half * push_x[pair], impact_x)
            impact_y = jnp.where(will_intersect[pair], half * push_y[pair], impact_y)
        for name, value in zip(columns, (crashed, struck, impact_x, impact_y), strict=True):
            columns[name].append(value)
    return none.replace(**{name: jnp.stack(values) for name, values in columns.items()})
