"""The size-weight illusion: a box that stands in a doorway is heavier than it looks.

A robot, a disc on a floor that is seen from above, has to get past a wall. In the wall is a doorway, and in it stands
a box: it can be pushed ahead and out of the way, to the goal. Or one walks around the wall, which takes longer. People
expect a box of that size to be light, and pushing it to be hardly slower than walking. In truth it brakes the robot at
every step, as they see of both.

Dynamics. Forces of at most `FORCE` along each axis drive the robot against a damping of `DAMPING`, so that it walks at
FORCE / DAMPING = 1.5 m/s. The box, of mass m, slides along the doorway and is held back by the floor's dry friction
mu m g, which follows from its mass. Pushed steadily it moves at (FORCE - mu m g) / DAMPING: 0.76 m/s, where people
expect 1.35 m/s.

Lengths are in m, masses in kg, times in s. x leads through the doorway, y along the wall.
"""

from __future__ import annotations

import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array

from peps_envs.bridges.from_mjx import FromMjx, from_mjx, mjx
from peps_envs.scene import Circle, Rectangle, Scene, area

SIZE = (3.6, 3.8)  # m, of the room; it ends where the robot's rim would touch its outer walls
START = (0.6, 1.2)  # m
GOAL = (2.2, 0.0, 3.6, 1.65)  # m, the least x and y and the largest
WALLS = ((1.4, 0.0, 1.8, 0.75), (1.4, 1.65, 1.8, 2.9))  # m, below the doorway and above it
BOX = (1.6, 1.2)  # m, its centre at the start
BOX_HALF = (0.3, 0.42)  # m, half its depth and width
RADIUS = 0.3  # m, of the robot
HEIGHT = 0.3  # m, half of what stands on the floor: nothing of it is seen from above

FORCE = 60.0  # N, the most along each axis
FULL_ACTION = 0.7  # from which on it is had: a policy that is squashed into [-1, 1] never reaches its ends
DAMPING = 40.0  # N s/m, of the robot
ROBOT_MASS = 2.0  # kg
FRICTION = 0.3  # mu, between box and floor
GRAVITY = 9.81  # m/s^2, by which the box presses on the floor

TRUE_MASS = 10.0  # kg, of the box
LOOKS_LIGHT = 2.0  # kg, what is expected of a box of its size
LOOKS_HEAVY = 20.0  # kg, the illusion the other way round: too heavy to be pushed at more than a crawl
MISJUDGED = ("mass of the box, kg", TRUE_MASS, LOOKS_LIGHT)  # in truth, and as people take it

TIMESTEP = 0.04  # s
SUBSTEPS = 5  # a step of the environment takes 0.2 s
HORIZON = 60  # steps
PERCEPTION_WIDTH = 0.05  # m, sigma_p of the robot's x and y and of the box's x

STEP_REWARD = -0.6
PROGRESS_REWARD = 1.0  # per m that the distance to the goal shrinks
GOAL_REWARD = 100.0

# With fewer iterations of the line search, a heavy box that is held by friction creeps.
XML = """
<mujoco model="box">
  <option timestep="{timestep}" integrator="implicitfast" iterations="4" ls_iterations="20" gravity="0 0 0"/>
  <default>
    <geom condim="1" solref="{stiffness} 1"/>
    <joint type="slide" limited="true" solreflimit="{stiffness} 1" solreffriction="{stiffness} 1"/>
  </default>
  <worldbody>
    {walls}
    <body name="robot" pos="{start[0]} {start[1]} 0">
      <joint name="x" axis="1 0 0" ref="{start[0]}" range="{radius} {right}" damping="{damping}"/>
      <joint name="y" axis="0 1 0" ref="{start[1]}" range="{radius} {top}" damping="{damping}"/>
      <geom type="sphere" size="{radius}" mass="{robot_mass}" contype="1" conaffinity="0"/>
    </body>
    <body name="box" pos="{box[0]} {box[1]} 0">
      <joint name="along" axis="1 0 0" ref="{box[0]}" range="{box_low} {box_high}" frictionloss="{friction}"/>
      <geom type="box" size="{box_half[0]} {box_half[1]} {height}" mass="{mass}" contype="0" conaffinity="1"/>
    </body>
  </worldbody>
  <actuator>
    <general joint="x" gainprm="{gain}" ctrlrange="-1 1" forcerange="-{force} {force}"/>
    <general joint="y" gainprm="{gain}" ctrlrange="-1 1" forcerange="-{force} {force}"/>
  </actuator>
</mujoco>"""


def model(mass: float = TRUE_MASS) -> mujoco.MjModel:
    """The room with a box of `mass` kg."""
    return mujoco.MjModel.from_xml_string(
        XML.format(
            mass=mass,
            friction=FRICTION * mass * GRAVITY,
            timestep=TIMESTEP,
            stiffness=2 * TIMESTEP,  # s, the stiffest contact that is stable
            walls="\n    ".join(_wall(*bounds) for bounds in WALLS),
            start=START,
            radius=RADIUS,
            right=SIZE[0] - RADIUS,
            top=SIZE[1] - RADIUS,
            damping=DAMPING,
            robot_mass=ROBOT_MASS,
            box=BOX,
            box_half=BOX_HALF,
            box_low=BOX_HALF[0],
            box_high=SIZE[0] - BOX_HALF[0],
            height=HEIGHT,
            force=FORCE,
            gain=FORCE / FULL_ACTION,
        )
    )


def _wall(x0: float, y0: float, x1: float, y1: float) -> str:
    place, half = f"{(x0 + x1) / 2} {(y0 + y1) / 2} 0", f"{(x1 - x0) / 2} {(y1 - y0) / 2} {HEIGHT}"
    return f'<geom type="box" pos="{place}" size="{half}" contype="0" conaffinity="1"/>'


def observe(data: mjx.Data) -> Array:
    """Places of robot and box, (3,), and their velocities, (3,), scaled to [-1, 1]."""
    size = jnp.array([SIZE[0], SIZE[1], SIZE[0]])
    return jnp.concatenate([2 * data.qpos / size - 1, data.qvel * DAMPING / FORCE])


def perceive(data: mjx.Data) -> Array:
    """Where people see the robot, x and y, and the box, x, in m: (3,)."""
    return data.qpos


def goal_reached(data: mjx.Data) -> Array:
    """Whether the robot's middle is in the goal."""
    x, y = data.qpos[0], data.qpos[1]
    x0, y0, x1, y1 = GOAL
    return (x > x0) & (x < x1) & (y > y0) & (y < y1)


def reward(data: mjx.Data, action: Array, after: mjx.Data, judge: mjx.Model) -> Array:
    """A price for every step, what the distance to the goal shrank by, and the goal itself."""
    del action, judge
    progress = _distance(data) - _distance(after)
    return STEP_REWARD + PROGRESS_REWARD * progress + GOAL_REWARD * goal_reached(after)


def _distance(data: mjx.Data) -> Array:
    """How far it is to the goal as the crow flies, in m; 0 inside."""
    low, high = jnp.array(GOAL[:2]), jnp.array(GOAL[2:])
    place = data.qpos[:2]
    away = jnp.maximum(jnp.maximum(low - place, place - high), 0.0)
    return jnp.sqrt(jnp.sum(away**2))


def scene(compiled: mujoco.MjModel, data: mujoco.MjData) -> Scene:
    """The room from above, with the robot's way into the doorway barred by the box."""
    del compiled
    x, y, along = (float(place) for place in np.asarray(data.qpos))
    box = Rectangle(along, BOX[1], 2 * BOX_HALF[0], 2 * BOX_HALF[1], "other", outline="ink")
    shapes = (area((0.0, 0.0, *SIZE), "floor"), area(GOAL, "goal"), *(area(wall, "wall") for wall in WALLS), box)
    border = 0.08
    extent = (-border, SIZE[0] + border, -border, SIZE[1] + border)
    return Scene((*shapes, Circle(x, y, RADIUS, "agent", outline="ink")), extent, background="wall")


def domain() -> tuple[FromMjx, mjx.Model, dict[str, mjx.Model]]:
    """The environment, its true model, and beliefs by their names.

    `biased` expects the light box that it looks like, `heavy` one that can hardly be pushed, `unbiased` knows its mass.
    """
    environment = from_mjx(
        model(),
        reward,
        perceive,
        (PERCEPTION_WIDTH,) * 3,
        horizon=HORIZON,
        substeps=SUBSTEPS,
        observe=observe,
        terminated=goal_reached,
        events={"goal_reached": goal_reached},
        scene=scene,
    )
    masses = {"biased": LOOKS_LIGHT, "heavy": LOOKS_HEAVY, "unbiased": TRUE_MASS}
    beliefs = {name: environment.model(model(mass)) for name, mass in masses.items()}
    return environment, environment.model(model()), beliefs
