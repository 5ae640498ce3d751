"""A sled at black ice, which people take for wet asphalt.

A propeller pushes the sled from the south-west corner to a goal in the north-east. It stands on a runner that touches the
ground under gravity, so that Coulomb friction brakes it. Packed snow (friction 0.25) lies along the west and the north; the
ground between is iced over (0.05). Straight over the ice is quickest. Who takes it for wet asphalt (0.5) expects the sled to lose
another (0.5 - 0.05) g = 4.4 m/s^2 there, which is 0.9 m/s in a control step of 0.2 s; on the snow it moves as expected.

The snow lies on two planes that rise by 5 cm a metre from the pond's shore: MuJoCo's planes are infinite, and of planes
that cut each other the higher one carries the sled. It is the ground's friction that decides (`priority`).
"""

from __future__ import annotations

import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array

from peps_envs.bridges.from_mjx import FromMjx, from_mjx, mjx
from peps_envs.scene import Circle, Polyline, Scene, area

ICE = 0.05  # friction of wet ice
SNOW = 0.25  # friction of packed snow
ASPHALT = 0.5  # friction of wet asphalt, for which people take the ice
RADIUS = 0.15  # m, of the sled's runner, a ball that doesn't roll
HALF = 2.0  # m, half the arena's width
START = (-1.45, -1.3)  # m
SHORE = (-0.8, 0.8)  # m, x and y where the pond begins in the west and ends in the north
GOAL = (1.35, 0.8, 2.0, 1.45)  # m, (x0, y0, x1, y1)
SLOPE = 0.05  # of the snow, up from the shore
SINKS = 0.025  # m, what the ground gives way under the sled's weight: g d (1 - d) timeconst^2
SUBSTEPS = 4  # of 0.05 s
HORIZON = 100  # control steps
WIDTH = (0.2, 0.2, 0.3, 0.3)  # sigma_p of place, m, and of velocity, m/s
STEP_PRICE = 0.35
PROGRESS = 2.0  # per metre that the distance to the goal shrinks
GOAL_REWARD = 90.0
TOP_SPEED = 2.5  # m/s, to which observed velocities are scaled
GLIDE = 0.3  # s, for which the drawn line shows the sled's velocity

MISJUDGED = ("friction of the ice", ICE, ASPHALT)  # in truth, and as people take it

# MuJoCo's friction lifts what slides fast, so that it hops; a soft ground (`solimp`) and damping of z keep the sled in touch. With
# fewer than 20 iterations of the line search the elliptic cone doesn't converge at rest.
XML = """
<mujoco model="ice">
  <option timestep="0.05" integrator="implicitfast" cone="elliptic" jacobian="dense" iterations="6" ls_iterations="20"
    tolerance="1e-10"/>
  <default>
    <geom condim="3" solref="0.1 1" solimp="0.5 0.5 0.001"/>
    <default class="ground"><geom type="plane" size="4 4 1" priority="1" contype="2" conaffinity="1"/></default>
  </default>
  <worldbody>
    <geom name="ice" class="ground" friction="{ice} 0 0"/>
    <geom name="west" class="ground" pos="{west} 0 0" zaxis="{slope} 0 1" friction="{snow} 0 0"/>
    <geom name="north" class="ground" pos="0 {north} 0" zaxis="0 -{slope} 1" friction="{snow} 0 0"/>
    <body name="sled" pos="0 0 {height}">
      <joint name="x" type="slide" axis="1 0 0" damping="2.5" range="-{reach} {reach}" solreflimit="0.1 1"/>
      <joint name="y" type="slide" axis="0 1 0" damping="2.5" range="-{reach} {reach}" solreflimit="0.1 1"/>
      <joint name="z" type="slide" axis="0 0 1" damping="30"/>
      <geom name="sled" type="sphere" size="{radius}" mass="1" contype="1" conaffinity="2"/>
    </body>
  </worldbody>
  <actuator>
    <motor joint="x" gear="8" ctrlrange="-1 1"/>
    <motor joint="y" gear="8" ctrlrange="-1 1"/>
  </actuator>
</mujoco>"""


def model(friction: float = ICE) -> mujoco.MjModel:
    """The sled at a pond whose ice has this friction, compiled; heights are above the ice, positions the arena's own."""
    height = SLOPE * (SHORE[0] - START[0]) + RADIUS - SINKS  # at the start
    return mujoco.MjModel.from_xml_string(
        XML.format(
            ice=friction,
            snow=SNOW,
            west=SHORE[0],
            north=SHORE[1],
            slope=SLOPE,
            height=height,
            reach=HALF - RADIUS,
            radius=RADIUS,
        )
    )


def start(key: Array, data: mjx.Data) -> mjx.Data:
    """At rest in the south-west, on the snow."""
    del key
    return data.replace(qpos=jnp.array([*START, 0.0]))


def observe(data: mjx.Data) -> Array:
    """Position and velocity over ground, scaled to about [-1, 1], with a sine and cosine of each coordinate: (8,).

    The ground changes at the shore; the waves let a small network see where.
    """
    place = data.qpos[:2] / HALF
    return jnp.concatenate([place, data.qvel[:2] / TOP_SPEED, jnp.sin(jnp.pi * place), jnp.cos(jnp.pi * place)])


def position(data: mjx.Data) -> Array:
    """Where the sled is, (2,) m."""
    return data.qpos[:2]


def perceive(data: mjx.Data) -> Array:
    """What people compare: where the sled is, m, and how fast and where to it slides, m/s, (4,)."""
    return jnp.concatenate([data.qpos[:2], data.qvel[:2]])


def distance(data: mjx.Data) -> Array:
    """From the sled's centre to the goal area, m; 0 inside."""
    low, high = jnp.array(GOAL[:2]), jnp.array(GOAL[2:])
    short = jnp.maximum(jnp.maximum(low - position(data), position(data) - high), 0.0)
    return jnp.sqrt(jnp.sum(short**2))


def arrived(data: mjx.Data) -> Array:
    """Whether the sled's centre is in the goal area."""
    return distance(data) <= 0


def reward(data: mjx.Data, action: Array, after: mjx.Data, believed: mjx.Model) -> Array:
    """-0.35 a step, 2 for each metre nearer to the goal, and 90 in it; the same to the agent and to people."""
    del action, believed
    return PROGRESS * (distance(data) - distance(after)) - STEP_PRICE + GOAL_REWARD * arrived(after)


def scene(compiled: mujoco.MjModel, data: mujoco.MjData) -> Scene:
    """The pond from above, its scratches, and the sled with a line that shows its velocity."""
    del compiled
    place = np.asarray(data.qpos[:2])
    ahead = np.clip(place + GLIDE * np.asarray(data.qvel[:2]), -HALF, HALF)
    scratches = (
        ((-0.4, -1.5), (0.3, -0.9)),
        ((0.6, -0.3), (1.5, 0.2)),
        ((-0.5, 0.1), (-0.1, 0.4)),
        ((1.0, -1.6), (1.7, -1.2)),
    )
    shapes = (
        area((-HALF, -HALF, HALF, HALF), "snow"),
        area((SHORE[0], -HALF, HALF, SHORE[1]), "ice"),
        *(Polyline(line, "floor") for line in scratches),
        area(GOAL, "goal"),
        Polyline((tuple(map(float, place)), tuple(map(float, ahead))), "ink"),
        Circle(float(place[0]), float(place[1]), RADIUS, "agent", outline="ink"),
    )
    return Scene(shapes, (-HALF, HALF, -HALF, HALF))


def domain() -> tuple[FromMjx, mjx.Model, dict[str, mjx.Model]]:
    """The task, its true model, and beliefs: `biased` takes ice for wet asphalt, `unbiased` knows it."""
    environment = from_mjx(
        model(),
        reward,
        perceive,
        WIDTH,
        horizon=HORIZON,
        substeps=SUBSTEPS,
        observe=observe,
        terminated=arrived,
        events={"goal_reached": arrived},
        start=start,
        scene=scene,
    )
    truth = environment.model(model())
    return environment, truth, {"biased": environment.model(model(ASPHALT)), "unbiased": truth}
