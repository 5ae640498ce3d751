"""The road: what happens on it in one simulation step, and in one policy step of several."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array

from peps_envs.highway import collision, traffic, vehicle
from peps_envs.highway.traffic import Drivers, Habits
from peps_envs.highway.vehicle import Control, Friction, Gains, Vehicles


@dataclasses.dataclass(frozen=True)
class Road:
    """A straight road and its clock: what shapes a simulation."""

    lanes: int = 2
    simulation_hz: int = 15
    policy_hz: int = 1
    follows: bool = False  # whether anybody follows the IDM

    @property
    def frames(self) -> int:
        """Simulation steps in a policy step."""
        return self.simulation_hz // self.policy_hz

    @property
    def dt(self) -> float:
        """Seconds of a simulation step."""
        return 1 / self.simulation_hz


@struct.dataclass
class Physics:
    """The numbers of the simulation, without those of any scenario."""

    friction: Friction
    gains: Gains
    habits: Habits
    contact: Array  # m, the gap up to which cars collide: 0
    target_speeds: Array  # (m,) m/s, evenly spaced, among which FASTER and SLOWER choose


def highway_env(target_speeds: Sequence[float] = (20.0, 25.0, 30.0)) -> Physics:
    """highway-env's own numbers, without friction."""
    physics = Physics(
        friction=Friction(mean=math.inf, sd=0.0, engine=math.inf),
        gains=Gains(speed=1 / 0.6, heading=1 / 0.2, lateral=1 / 0.6),
        habits=Habits(
            acceleration=3.0, deceleration=5.0, limit=6.0, distance=10.0, time_gap=1.5, exponent=4.0, least_gain=0.2,
            imposed_braking=2.0,
        ),
        contact=0.0, target_speeds=np.asarray(target_speeds),
    )  # fmt: skip
    return jax.tree.map(lambda value: jnp.asarray(value, jnp.result_type(float)), physics)


def simulate(
    road: Road, vehicles: Vehicles, drivers: Drivers, time: Array, mu: Array, physics: Physics
) -> tuple[Vehicles, Control]:
    """One simulation step: all choose from the same old state, all move, all pairs are tested for collision.

    Args:
      time: () s, since the start.
      mu: () friction coefficient under the ego; the others get what they ask for.

    Returns:
      vehicles: after the step.
      control: (n,) that was really used.
    """
    number = vehicles.x.shape[0]
    acceleration = traffic.script(vehicles, drivers, time, road.dt)
    slip = jnp.zeros_like(acceleration)
    steer = lambda who: vehicle.steer(
        vehicles.y[who], vehicles.heading[who], vehicles.speed[who], vehicles.target_lane[who], physics.gains
    )
    if road.follows:
        delay = traffic.steps_until(0.0, road.dt)
        vehicles, following = traffic.follow(vehicles, drivers, road.lanes, delay, physics.habits)
        acceleration = jnp.where(drivers.follows, following, acceleration)
        slip = jnp.where(drivers.follows, steer(slice(None)), 0.0)
    speed = vehicles.speed[0]
    ego = Control(steer(0), physics.gains.speed * (vehicles.target_speed[0] - speed))
    ego = vehicle.grip(ego, speed, mu, physics.friction.engine)
    is_ego = jnp.arange(number) == 0
    control = Control(jnp.where(is_ego, ego.slip, slip), jnp.where(is_ego, ego.acceleration, acceleration))
    control = vehicle.override(control, vehicles.speed, vehicles.crashed)
    return collision.collide(vehicle.move(vehicles, control, road.dt), road.dt, physics.contact), control


def advance(
    road: Road, vehicles: Vehicles, drivers: Drivers, step: Array, action: Array, mu: Array, physics: Physics
) -> tuple[Vehicles, tuple[Vehicles, Control]]:
    """One policy step, number `step`, that begins with the ego's meta-action.

    Returns:
      vehicles: after the step.
      trace: vehicles and control of every simulation step, (frames, n).
    """
    vehicles = vehicle.decide(vehicles, action, physics.target_speeds, road.lanes)

    def frame(vehicles: Vehicles, number: Array) -> tuple[Vehicles, tuple[Vehicles, Control]]:
        time = (step * road.frames + number) * road.dt
        vehicles, control = simulate(road, vehicles, drivers, time, mu, physics)
        return vehicles, (vehicles, control)

    return jax.lax.scan(frame, vehicles, jnp.arange(road.frames))
