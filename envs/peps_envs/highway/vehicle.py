"""A car: kinematic bicycle, lane and speed control, five meta-actions, and what the road's friction leaves of a command.

The equations are highway-env's (Leurent 2018), except for the friction circle. x runs along the road, y to the right; lane k
has its centre at y = 4 k.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import jax.numpy as jnp
from flax import struct
from jax import Array

LENGTH = 5.0  # m
WIDTH = 2.0  # m
LANE_WIDTH = 4.0  # m
ROAD_LENGTH = 10_000.0  # m
MAX_SPEED = 40.0  # m/s, beyond which a car is slowed down
GRAVITY = 9.81  # m/s^2

LANE_LEFT, IDLE, LANE_RIGHT, FASTER, SLOWER = range(5)

_MAX_SINE = math.sqrt(3 / 7)  # sin(atan(tan(pi/3) / 2)): the slip at the steering's limit of pi/3


@struct.dataclass
class Vehicles:
    """What moves. Vehicle 0 is the ego; every field is (n,)."""

    x: Array  # m
    y: Array  # m
    heading: Array  # rad
    speed: Array  # m/s
    x_rest: Array  # m, what rounding has cut off x so far
    speed_rest: Array  # m/s, the same of the speed
    target_lane: Array  # int, of those who steer
    target_speed: Array  # m/s, 0 of those who have none
    wait: Array  # int, simulation steps until the driver considers a lane change
    impact_x: Array  # m, by which a collision will displace it in the next step
    impact_y: Array  # m
    struck: Array  # bool, such a displacement is due
    crashed: Array  # bool


class Control(NamedTuple):
    """A command to the car. `slip` is sin(beta) of the bicycle's slip angle, tan(beta) = tan(steering) / 2."""

    slip: Array
    acceleration: Array  # m/s^2


@struct.dataclass
class Gains:
    """How sharply a car is controlled; highway-env's are 1/0.6, 1/0.2 and 1/0.6."""

    speed: Array  # 1/s
    heading: Array  # 1/s
    lateral: Array  # 1/s


@struct.dataclass
class Friction:
    """What tyres and engine can do: mu ~ clip(N(mean, sd^2), mean +- 2 sd). An infinite mean means no limit at all."""

    mean: Array
    sd: Array
    engine: Array  # m/s^2, the largest acceleration where mu is finite


def not_zero(value: Array) -> Array:
    """`value`, kept at least 0.01 away from 0."""
    return jnp.where(jnp.abs(value) > 0.01, value, jnp.where(value >= 0, 0.01, -0.01))


def wrap(angle: Array) -> Array:
    """`angle` in [-pi, pi)."""
    # a remainder is exact where a quotient's rounding hangs on how it is compiled: at -pi that would turn a car the other way
    around = jnp.mod(angle + math.pi, 2 * math.pi) - math.pi
    return jnp.where(jnp.abs(angle) < math.pi, angle, around)


def closest_lane(x: Array, y: Array, lanes: int) -> Array:
    """The lane that a position belongs to, the left one at a tie."""
    beyond = jnp.maximum(x - ROAD_LENGTH, 0) + jnp.maximum(-x, 0)
    distances = jnp.stack([jnp.abs(y - LANE_WIDTH * lane) + beyond for lane in range(lanes)])
    return jnp.argmin(distances, axis=0).astype(jnp.int32)


def on_lane(x: Array, y: Array, lane: Array, margin: float = 0.0) -> Array:
    """Whether a position lies on `lane`, or at most `margin` metres beside it."""
    beside = jnp.abs(y - LANE_WIDTH * lane)
    return (beside <= LANE_WIDTH / 2 + margin) & (x >= -LENGTH) & (x < ROAD_LENGTH + LENGTH)


def reachable(x: Array, y: Array, lane: Array) -> Array:
    """Whether one may change to `lane` from a position."""
    return (jnp.abs(y - LANE_WIDTH * lane) <= 2 * LANE_WIDTH) & (x >= 0) & (x < ROAD_LENGTH + LENGTH)


def nearest_speed(speed: Array, grid: Array) -> Array:
    """The index of the speed in the evenly spaced `grid` (m,) that is nearest to `speed`."""
    share = (speed - grid[0]) / (grid[-1] - grid[0])
    return jnp.clip(jnp.round(share * (grid.shape[0] - 1)), 0, grid.shape[0] - 1).astype(jnp.int32)


def decide(vehicles: Vehicles, action: Array, target_speeds: Array, lanes: int) -> Vehicles:
    """The ego's meta-action: it moves the target lane by one, or sets the target speed to a neighbour of the current speed."""
    x, y, lane, action = vehicles.x[0], vehicles.y[0], vehicles.target_lane[0], jnp.asarray(action)
    sideways = (action == LANE_RIGHT).astype(jnp.int32) - (action == LANE_LEFT)
    candidate = jnp.clip(lane + sideways, 0, lanes - 1)
    lane = jnp.where(reachable(x, y, candidate), candidate, lane)
    onwards = (action == FASTER).astype(jnp.int32) - (action == SLOWER)
    index = jnp.clip(nearest_speed(vehicles.speed[0], target_speeds) + onwards, 0, target_speeds.shape[0] - 1)
    speed = jnp.where(onwards != 0, target_speeds[index], vehicles.target_speed[0])
    return vehicles.replace(
        target_lane=vehicles.target_lane.at[0].set(lane), target_speed=vehicles.target_speed.at[0].set(speed)
    )


def steer(y: Array, heading: Array, speed: Array, target_lane: Array, gains: Gains) -> Array:
    """sin(beta) that leads to `target_lane`: lateral position -> heading -> yaw rate -> slip.

    psi_ref = clip(asin(-K_y e / v), -pi/4, pi/4), rate = K_psi wrap(psi_ref - psi), sin(beta) = rate L / (2 v). The steering
    angle would be clip(atan(2 tan(beta)), -pi/3, pi/3), and clipping the sine first is the same without its pole: in float32
    atan(2 tan(asin(1))) comes out as -pi/2.
    """
    speed = not_zero(speed)
    sine = -gains.lateral * (y - LANE_WIDTH * target_lane) / speed
    heading_ref = jnp.arcsin(jnp.clip(sine, -math.sqrt(0.5), math.sqrt(0.5)))
    rate = gains.heading * wrap(heading_ref - heading)
    return jnp.clip(LENGTH / 2 / speed * rate, -_MAX_SINE, _MAX_SINE)


def steering_angle(slip: Array) -> Array:
    """The front wheels' angle, rad, atan(2 tan(beta)) of `slip` = sin(beta)."""
    return jnp.arctan(2 * slip / jnp.sqrt(1 - slip**2))


def grip(control: Control, speed: Array, mu: Array, engine: Array) -> Control:
    """What the friction circle leaves of a command.

    The yaw rate v sin(beta) / (L/2) is limited to mu g / max(v, 1), which takes the lateral acceleration a_y = v * rate; the
    longitudinal one is limited to sqrt((mu g)^2 - a_y^2), and by the engine.
    """
    most = mu * GRAVITY
    limit = most / jnp.maximum(speed, 1.0) * (LENGTH / 2) / jnp.maximum(jnp.abs(speed), 0.01)
    slip = jnp.clip(control.slip, -limit, limit)
    lateral = speed**2 * slip / (LENGTH / 2)
    left = jnp.sqrt(jnp.maximum(most**2 - lateral**2, 0.0))
    forwards = jnp.where(jnp.isinf(mu), jnp.inf, jnp.minimum(left, engine))
    return Control(slip, jnp.clip(control.acceleration, -left, forwards))


def override(control: Control, speed: Array, crashed: Array) -> Control:
    """A crashed car rolls out straight, and one beyond 40 m/s is slowed down."""
    slip = jnp.where(crashed, 0.0, control.slip)
    acceleration = jnp.where(crashed, -speed, control.acceleration)
    acceleration = jnp.where(speed > MAX_SPEED, jnp.minimum(acceleration, MAX_SPEED - speed), acceleration)
    acceleration = jnp.where(speed < -MAX_SPEED, jnp.maximum(acceleration, -MAX_SPEED - speed), acceleration)
    return Control(slip, acceleration)


def add(value: Array, rest: Array, change: Array) -> tuple[Array, Array]:
    """`value` + `rest` + `change`, and what rounding cuts off it: Kahan's sum, for hundreds of small steps in single precision.

    Double precision can do without, and then rounds as highway-env does.
    """
    if value.dtype == jnp.float64:
        return value + change, rest
    change = change + rest
    total = value + change
    return total, change - (total - value)


def move(vehicles: Vehicles, control: Control, dt: float) -> Vehicles:
    """The kinematic bicycle, Euler, right-hand sides from the old state; a due impact displaces, and is a crash.

    x' = v cos(psi + beta), y' = v sin(psi + beta), psi' = v sin(beta) / (L/2), v' = a.
    """
    speed, sine = vehicles.speed, control.slip
    cosine = jnp.sqrt(1 - sine**2)
    ahead, aside = jnp.cos(vehicles.heading), jnp.sin(vehicles.heading)
    displacement = speed * (ahead * cosine - aside * sine) * dt + vehicles.impact_x
    x, x_rest = add(vehicles.x, vehicles.x_rest, displacement)
    new_speed, speed_rest = add(speed, vehicles.speed_rest, control.acceleration * dt)
    return vehicles.replace(
        x=x,
        y=vehicles.y + speed * (aside * cosine + ahead * sine) * dt + vehicles.impact_y,
        heading=vehicles.heading + speed * sine / (LENGTH / 2) * dt,
        speed=new_speed,
        x_rest=x_rest,
        speed_rest=speed_rest,
        crashed=vehicles.crashed | vehicles.struck,
        wait=vehicles.wait - 1,
    )
