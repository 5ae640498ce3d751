"""An arm that carries what is heavier than it looks from the upper left to the upper right, in a vertical plane.

The shoulder's motor turns the arm, the elbow's servo bends it a little. There are two ways. Over the top is the short one,
80 degrees of arc against gravity: how fast a torque moves the payload depends on its mass m, about torque / (m length), so that
who takes it for light is surprised at each step. Down and under the shoulder are 280 degrees, but gravity drives the payload
there and back up, and free fall doesn't depend on the mass. The motor has to make up for the friction in the shoulder alone;
then who knows the mass and who doesn't expect the same. People see the payload's place to 4 cm (sigma_p).
"""

from __future__ import annotations

import math
from typing import Any

import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array

from peps_envs.bridges.from_mjx import FromMjx, from_mjx, mjx
from peps_envs.scene import Circle, Rectangle, Scene

UPPER, FOREARM = 0.55, 0.45  # m, lengths of the links
PAYLOAD, LOOKS = 6.0, 1.5  # kg, its mass and what people take it for
RADIUS = 0.12  # m, of the payload
SHOULDER = 90.0  # N m, most torque of the motor; 66 N m hold the stretched arm with the payload level
FRICTION = 16.0  # N m s, viscous, in the shoulder: without a load its motor turns with 5.6 rad/s at most
BEND = 0.5  # rad, most that the elbow bends to either side
SIDE = math.radians(40.0)  # from upright, of start and goal
TOLERANCE = 0.25  # m within which the payload is at the goal
# Swinging to and fro has to cost more than Eq. (6) pays for the entropy of a T_A that hasn't learned its swings yet.
STEP_REWARD, GOAL_REWARD = -0.7, 100.0
PERCEPTION_WIDTH = 0.04  # m, sigma_p in either direction of the plane
HORIZON, SUBSTEPS = 60, 4  # steps of 0.1 s
SWIFT, TURNING = 5.0, 6.0  # m/s and rad/s, units in which speeds are observed

# m, x to the right and z upwards from the shoulder
GOAL = (UPPER + FOREARM) * np.array([math.sin(SIDE), math.cos(SIDE)])

MISJUDGED = ("mass of the payload, kg", PAYLOAD, LOOKS)  # in truth, and as people take it

XML = f"""
<mujoco model="reacher">
  <option timestep="0.025" integrator="implicitfast"><flag contact="disable"/></option>
  <worldbody>
    <body name="upper arm" euler="0 {-math.degrees(SIDE)} 0">
      <joint name="shoulder" axis="0 1 0" ref="{-math.degrees(SIDE)}" damping="{FRICTION}"/>
      <geom type="capsule" fromto="0 0 0 0 0 {UPPER}" size="0.05" mass="0.9"/>
      <body name="forearm" pos="0 0 {UPPER}">
        <joint name="elbow" axis="0 1 0"/>
        <geom type="capsule" fromto="0 0 0 0 0 {FOREARM}" size="0.04" mass="0.6"/>
        <geom type="sphere" pos="0 0 {FOREARM}" size="{RADIUS}" mass="{{payload}}"/>
        <site name="payload" pos="0 0 {FOREARM}"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <motor joint="shoulder" gear="{SHOULDER}" ctrlrange="-1 1"/>
    <position joint="elbow" kp="1500" kv="300" ctrlrange="{-BEND} {BEND}"/>
  </actuator>
</mujoco>"""


def model(payload: float = PAYLOAD) -> mujoco.MjModel:
    """The arm with a payload of so many kg, at the start; its shoulder's angle is 0 upright and grows to the right."""
    return mujoco.MjModel.from_xml_string(XML.format(payload=payload))


def domain() -> tuple[FromMjx, mjx.Model, dict[str, Any]]:
    """The environment, its true model, and the beliefs: `biased` takes the payload for as light as it looks."""
    environment = from_mjx(
        model(),
        reward,
        place,
        (PERCEPTION_WIDTH, PERCEPTION_WIDTH),
        horizon=HORIZON,
        substeps=SUBSTEPS,
        observe=observe,
        terminated=at_goal,
        events={"goal_reached": at_goal},
        scene=scene,
    )
    truth = environment.model(model())
    return environment, truth, {"biased": environment.model(model(LOOKS)), "unbiased": truth}


def reward(before: mjx.Data, action: Array, after: mjx.Data, params: mjx.Model) -> Array:
    """Every step costs, and the goal pays."""
    del before, action, params
    return STEP_REWARD + GOAL_REWARD * at_goal(after)


def at_goal(data: mjx.Data) -> Array:
    """Whether the payload is there."""
    return jnp.sum((place(data) - jnp.asarray(GOAL)) ** 2) <= TOLERANCE**2


def place(data: mjx.Data) -> Array:
    """The payload's x to the right and z upwards from the shoulder, (2,) m."""
    return data.site_xpos[0, ::2]


def velocity(data: mjx.Data) -> Array:
    """The payload's, (2,) m/s: each joint turns it about itself, v = sum_j w_j (z - z_j, x_j - x)."""
    levers = place(data)[None] - data.xpos[1:, ::2]  # from shoulder and elbow
    return data.qvel @ jnp.stack([levers[:, 1], -levers[:, 0]], axis=1)


def observe(data: mjx.Data) -> Array:
    """The payload's place and velocity, the elbow's angle and speed: what happens next is nearly linear in them."""
    elbow = jnp.stack([data.qpos[1] / BEND, data.qvel[1] / TURNING])
    return jnp.concatenate([place(data), velocity(data) / SWIFT, elbow])


def scene(compiled: mujoco.MjModel, data: mujoco.MjData) -> Scene:
    """The plane from the side: the goal's place, the ground, the arm, and the payload with the heavy core that it hides."""
    del compiled
    shoulder, elbow, payload = data.xpos[1, ::2], data.xpos[2, ::2], data.site_xpos[0, ::2]
    return Scene(
        (
            Rectangle(0.0, -1.38, 3.0, 0.14, "wall"),  # the ground: what is heavy falls there
            Circle(*_numbers(GOAL), TOLERANCE, "goal"),
            _link(shoulder, elbow, 0.1),
            _link(elbow, payload, 0.08),
            Circle(*_numbers(shoulder), 0.1, "wall"),
            Circle(*_numbers(elbow), 0.06, "agent", outline="ink"),
            Circle(*_numbers(payload), RADIUS, "other", outline="ink"),
            Circle(*_numbers(payload), RADIUS / 2, "ink"),
        ),
        extent=(-1.3, 1.3, -1.42, 1.3),
    )


def _link(one: np.ndarray, other: np.ndarray, thickness: float) -> Rectangle:
    """A bar between two places."""
    (along, up), angle = other - one, math.atan2(*(other - one)[::-1])
    return Rectangle(*_numbers((one + other) / 2), math.hypot(along, up), thickness, "agent", angle, outline="ink")


def _numbers(place: np.ndarray) -> tuple[float, float]:
    return float(place[0]), float(place[1])
