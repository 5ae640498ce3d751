"""Other drivers: those who follow a script, and those who follow the IDM and change lanes by MOBIL."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from flax import struct
from jax import Array

from peps_envs.highway.vehicle import Vehicles, closest_lane, not_zero, on_lane, reachable

NEIGHBOUR_MARGIN = 1.0  # m, beside a lane, where a car still counts as in it
SPEED_LIMIT = 30.0  # m/s
CHANGE_DELAY = 1.0  # s between two considerations of a lane change
LEAST_SPEED = 1.0  # m/s, below which nobody changes lanes


@struct.dataclass
class Drivers:
    """Who drives how; every field is (n,), and the ego's entries say nothing."""

    follows: Array  # bool, by the IDM; the others go straight on
    changes: Array  # bool, lanes too, by MOBIL
    deceleration: Array  # m/s^2, of the others once they brake
    onset: Array  # s, when they begin to


@struct.dataclass
class Habits:
    """The numbers of IDM and MOBIL, shared by all who follow them."""

    acceleration: Array  # m/s^2, comfortable
    deceleration: Array  # m/s^2, comfortable
    limit: Array  # m/s^2, the largest of both
    distance: Array  # m, desired between centres at rest
    time_gap: Array  # s
    exponent: Array
    least_gain: Array  # m/s^2 by which a lane change has to pay
    imposed_braking: Array  # m/s^2, the most it may impose on the new follower


class Neighbours(NamedTuple):
    """Who drives before and behind each car in a lane: indices (n,), and whether there is anybody."""

    front: Array
    has_front: Array
    rear: Array
    has_rear: Array


def steps_until(timer: float, dt: float) -> int:
    """How many times `dt` is added to `timer`, in double precision, until it exceeds the delay.

    Drivers count steps, because sums of `dt` in single precision exceed it a step earlier or later.
    """
    steps = 0
    while not timer > CHANGE_DELAY:
        timer, steps = timer + dt, steps + 1
    return steps


def script(vehicles: Vehicles, drivers: Drivers, time: Array, dt: float) -> Array:
    """Acceleration of those who brake from their onset until they stand."""
    # simulation times are multiples of dt that may round either way
    braking = time >= drivers.onset - 1e-5
    return jnp.where(braking, -jnp.minimum(drivers.deceleration, vehicles.speed / dt), 0.0)


def neighbours(vehicles: Vehicles, lane: Array) -> Neighbours:
    """The nearest cars ahead and behind in `lane` (n,), one for each car; a car at the same place counts as ahead."""
    number = vehicles.x.shape[0]
    x, own = vehicles.x[None, :], vehicles.x[:, None]
    there = on_lane(x, vehicles.y[None, :], lane[:, None], NEIGHBOUR_MARGIN) & ~jnp.eye(number, dtype=bool)
    ahead, behind = there & (x >= own), there & (x < own)
    # at a tie the last one is ahead and the first one behind, as in a search through the list
    front = number - 1 - jnp.argmin(jnp.where(ahead, x, jnp.inf)[:, ::-1], axis=1)
    rear = jnp.argmax(jnp.where(behind, x, -jnp.inf), axis=1)
    return Neighbours(front, ahead.any(1), rear, behind.any(1))


def desired_gap(vehicles: Vehicles, own: Array, front: Array, habits: Habits) -> Array:
    """d* = d0 + T v + v dv / (2 sqrt(a b)) of the cars `own` behind `front`, dv being the approach along the own heading."""
    ahead, aside = jnp.cos(vehicles.heading), jnp.sin(vehicles.heading)
    velocity_x, velocity_y = vehicles.speed * ahead, vehicles.speed * aside
    approach = (velocity_x[own] - velocity_x[front]) * ahead[own] + (velocity_y[own] - velocity_y[front]) * aside[own]
    speed = vehicles.speed[own]
    braking = 2 * jnp.sqrt(habits.acceleration * habits.deceleration)
    return habits.distance + speed * habits.time_gap + speed * approach / braking


def idm(vehicles: Vehicles, own: Array, front: Array, has_front: Array, habits: Habits) -> Array:
    """a = a0 (1 - (v / v0)^delta) - a0 (d* / d)^2, the Intelligent Driver Model (Treiber et al. 2000), for cars `own` (n,)."""
    speed = vehicles.speed[own]
    desired = not_zero(jnp.clip(vehicles.target_speed[own], 0.0, SPEED_LIMIT))
    free = habits.acceleration * (1 - (jnp.maximum(speed, 0) / desired) ** habits.exponent)
    gap = not_zero(vehicles.x[front] - vehicles.x[own])
    closing = habits.acceleration * (desired_gap(vehicles, own, front, habits) / gap) ** 2
    return free - jnp.where(has_front, closing, 0.0)


def mobil(vehicles: Vehicles, current: Neighbours, lane: Array, lanes: int, habits: Habits) -> Array:
    """Whether each car gains by a change to `lane` (n,) that is safe for its new follower (Kesting et al. 2007), politely 0."""
    own = jnp.arange(vehicles.x.shape[0])
    new = neighbours(vehicles, lane)
    imposed = jnp.where(new.has_rear, idm(vehicles, new.rear, own, new.has_rear, habits), 0.0)
    gain = idm(vehicles, own, new.front, new.has_front, habits) - idm(
        vehicles, own, current.front, current.has_front, habits
    )
    return (
        (lane >= 0)
        & (lane < lanes)
        & reachable(vehicles.x, vehicles.y, lane)
        & (jnp.abs(vehicles.speed) >= LEAST_SPEED)
        & (imposed >= -habits.imposed_braking)
        & (gain >= habits.least_gain)
    )


def change_lanes(
    vehicles: Vehicles, drivers: Drivers, lane: Array, current: Neighbours, lanes: int, delay: int, habits: Habits
) -> Vehicles:
    """Lane changes begun and abandoned. Drivers choose one after the other, because they mind who else wants the same lane."""
    number = vehicles.x.shape[0]
    left, right = mobil(vehicles, current, lane - 1, lanes, habits), mobil(vehicles, current, lane + 1, lanes, habits)
    attractive = jnp.where(right, lane + 1, jnp.where(left, lane - 1, vehicles.target_lane))

    everyone = jnp.arange(number)
    ongoing = lane != vehicles.target_lane
    chooses = drivers.changes & drivers.follows & ~vehicles.crashed
    considers = chooses & ~ongoing & (vehicles.wait <= 0)
    steers = drivers.follows | (everyone == 0)

    def choose(car: Array, target: Array) -> Array:
        distance = vehicles.x - vehicles.x[car]
        close = (distance > 0) & (distance < desired_gap(vehicles, jnp.full(number, car), everyone, habits))
        rivals = steers & (everyone != car) & (lane != target[car]) & (target == target[car]) & close
        changed = jnp.where(ongoing[car] & rivals.any(), lane[car], target[car])
        changed = jnp.where(considers[car], attractive[car], changed)
        return target.at[car].set(jnp.where(chooses[car], changed, target[car]))

    target = jax.lax.fori_loop(1, number, choose, vehicles.target_lane)
    return vehicles.replace(target_lane=target, wait=jnp.where(considers, delay, vehicles.wait))


def follow(vehicles: Vehicles, drivers: Drivers, lanes: int, delay: int, habits: Habits) -> tuple[Vehicles, Array]:
    """What those who follow the IDM choose: target lanes, and accelerations (n,).

    During a lane change the smaller acceleration of the two lanes counts.
    """
    own = jnp.arange(vehicles.x.shape[0])
    lane = closest_lane(vehicles.x, vehicles.y, lanes)
    current = neighbours(vehicles, lane)
    vehicles = change_lanes(vehicles, drivers, lane, current, lanes, delay, habits)
    coming = neighbours(vehicles, vehicles.target_lane)
    acceleration = jnp.minimum(
        idm(vehicles, own, current.front, current.has_front, habits),
        idm(vehicles, own, coming.front, coming.has_front, habits),
    )
    return vehicles, jnp.clip(acceleration, -habits.limit, habits.limit)
