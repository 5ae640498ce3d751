"""The paper's driving scenario (Sec. 5.2): the car in front brakes hard, on a dry road or in the rain.

Two lanes. The ego follows a car in the right lane (1) at equal speed, which begins to brake at a random time and stands in the
end; the left lane (0) is free, or has traffic in it. Every second the ego chooses one of highway-env's five meta-actions.
The only randomness after the start is the road's friction mu, drawn anew for every policy step. The scene is over after
`horizon` steps: what it is worth is a sum over it, the observation has the time, and so its end terminates it.

The true domain and the human's belief are two values of `HighwayParams`: a human who thinks that one brakes in the rain as
effectively as in the dry holds the dry road's friction for true.
"""

from __future__ import annotations

import dataclasses
import math
import statistics
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array

from peps_envs.environment import Bounds, Discrete, Environment, Step
from peps_envs.highway import classic, scene, traffic, vehicle
from peps_envs.highway.simulation import Physics, Road, advance
from peps_envs.highway.traffic import Drivers
from peps_envs.highway.vehicle import LANE_WIDTH, LENGTH, MAX_SPEED, WIDTH, Vehicles
from peps_envs.perception import Mixture
from peps_envs.scene import Scene

START = 100.0  # m, where the ego starts
CUT = 2.0  # standard deviations at which the friction coefficient's distribution is clipped
EGO_FEATURES, OTHER_FEATURES = 6, 4
# roughly the features' largest sizes, so that networks see numbers of order 1
SPEED_SCALE, GAP_SCALE, HEADING_SCALE, BRAKING_SCALE = 30.0, 50.0, 0.2, 6.0  # m/s, m, rad, m/s^2


@struct.dataclass
class Scenario:
    """What is drawn at the start, uniformly from (low, high) each."""

    speed: Array  # (2,) m/s, of all cars
    gap: Array  # (2,) m, from the ego's front to the other's rear
    deceleration: Array  # (2,) m/s^2, of the car in front
    onset: Array  # (2,) s, when it begins to brake
    spacing: Array  # (2,) m, between the centres of cars in the other lane; the first one starts behind the ego


@struct.dataclass
class Ratings:
    """Reward weights, as people rate importance. They are used relative to their sum."""

    speed: Array  # average speed
    distance: Array  # distance to the car in front
    relative_speed: Array  # speed relative to neighbouring cars
    lane: Array  # lane following


@struct.dataclass
class HighwayParams:
    """A domain, or a belief about one."""

    physics: Physics
    scenario: Scenario
    ratings: Ratings
    crash_reward: Array
    lane_change_cost: Array  # of a whole lane change, at any speed
    swerve_cost: Array  # of a whole lane change at `full_speed`, beside that; it grows with the speed squared
    full_speed: Array  # m/s, from which on driving faster is worth no more
    far: Array  # m, from which on a car in front or beside doesn't matter
    perception_width: Array  # (3,) sigma_p of gap (m), lateral position (m) and speed (m/s)


@struct.dataclass
class HighwayState:
    """Where everybody is, how the others will drive, and when."""

    vehicles: Vehicles
    drivers: Drivers
    time: Array  # () int, policy steps since the start


class Features(NamedTuple):
    """What a transition is rated by, each in [0, 1]."""

    speed: Array
    distance: Array
    relative_speed: Array
    lane: Array


def friction_nodes(points: int) -> np.ndarray:
    """Standardized friction coefficients (points,) that share its probability equally.

    Medians of equal parts of clip(N(0, 1), -2, 2), stretched so that they have its variance.
    """
    normal = statistics.NormalDist()
    medians = np.array([normal.inv_cdf((part + 0.5) / points) for part in range(points)])
    tail = normal.cdf(-CUT)
    variance = 1 - 2 * tail - 2 * CUT * normal.pdf(CUT) + 2 * CUT**2 * tail  # the middle's, and the two atoms'
    return medians * np.sqrt(variance / np.mean(medians**2)) if points > 1 else medians


@dataclasses.dataclass(frozen=True)
class Highway(Environment):
    """Avoid the car that brakes; see the module's text. Events: `crashed`, `changed_lane`."""

    horizon: int = 8  # policy steps
    traffic: int = 0  # cars in the other lane, which follow the IDM
    changes: bool = False  # whether those change lanes, by MOBIL
    simulation_hz: int = 15
    policy_hz: int = 1
    lanes: int = 2
    friction_points: int = 5  # outcomes in the distribution of the next state

    action_space = Discrete(5)
    event_names = ("crashed", "changed_lane")

    @property
    def road(self) -> Road:
        return Road(self.lanes, self.simulation_hz, self.policy_hz, follows=self.traffic > 0)

    @property
    def observation_size(self) -> int:
        return EGO_FEATURES + OTHER_FEATURES * (1 + self.traffic)

    @property
    def observation_space(self) -> Bounds:
        """Speeds up to what slows a car down, places on the road, headings that steering aims at.

        How far away others are and how hard they brake is the scenario's business: it has no bounds here.
        """
        lanes, speed = float(self.lanes), MAX_SPEED / SPEED_SCALE
        heading = math.pi / 4 / HEADING_SCALE
        own = [
            (0.0, speed),
            (-0.5, lanes - 0.5),
            (-heading, heading),
            (0.0, lanes - 1.0),
            (0.0, speed),
            (0.0, 1.0),
        ]
        theirs = [(-math.inf, math.inf), (-lanes, lanes), (-speed, speed), (0.0, math.inf)]
        low, high = zip(*own, *theirs * (1 + self.traffic), strict=True)
        return Bounds(low, high)

    def reset(self, key: Array, params: HighwayParams) -> tuple[HighwayState, Array]:
        key_speed, key_gap, key_deceleration, key_onset, key_spacing, key_wait = jax.random.split(key, 6)
        scenario, number = params.scenario, 2 + self.traffic
        draw = lambda key, limits, shape=(): jax.random.uniform(key, shape, minval=limits[0], maxval=limits[1])
        speed = draw(key_speed, scenario.speed)
        ahead = START + LENGTH + draw(key_gap, scenario.gap)
        spacing = jnp.cumsum(draw(key_spacing, scenario.spacing, (self.traffic,)))
        others = START + spacing - scenario.spacing[1]
        lane = jnp.where(jnp.arange(number) < 2, self.lanes - 1, self.lanes - 2).astype(jnp.int32)
        zeros, never = jnp.zeros(number, speed.dtype), jnp.zeros(number, bool)
        steered = jnp.arange(number) != 1
        wait = jnp.zeros(number, jnp.int32)
        if self.traffic:
            wait = jax.random.randint(key_wait, (number,), 0, traffic.steps_until(0.0, self.road.dt) + 1)
        vehicles = Vehicles(
            x=jnp.concatenate([jnp.stack([jnp.full_like(ahead, START), ahead]), others]),
            y=LANE_WIDTH * lane.astype(speed.dtype),
            heading=zeros,
            speed=jnp.full(number, speed),
            x_rest=zeros,
            speed_rest=zeros,
            target_lane=lane,
            target_speed=jnp.where(steered, speed, 0.0),
            wait=wait,
            impact_x=zeros,
            impact_y=zeros,
            struck=never,
            crashed=never,
        )
        front = jnp.arange(number) == 1
        drivers = Drivers(
            follows=jnp.arange(number) > 1,
            changes=jnp.full(number, self.changes),
            deceleration=jnp.where(front, draw(key_deceleration, scenario.deceleration), 0.0),
            onset=jnp.where(front, draw(key_onset, scenario.onset), jnp.inf),
        )
        state = HighwayState(vehicles=vehicles, drivers=drivers, time=jnp.zeros((), jnp.int32))
        return state, self.observe(state)

    def step(self, key: Array, state: HighwayState, action: Array, params: HighwayParams) -> Step:
        friction = params.physics.friction
        mu = friction.mean + friction.sd * jnp.clip(jax.random.normal(key, dtype=friction.mean.dtype), -CUT, CUT)
        next_state = self.advance(state, action, mu, params)
        before, after = (
            vehicle.closest_lane(moment.vehicles.x[0], moment.vehicles.y[0], self.lanes)
            for moment in (state, next_state)
        )
        crashed = next_state.vehicles.crashed[0]
        return Step(
            state=next_state,
            observation=self.observe(next_state),
            reward=self.reward(state, action, next_state, params),
            terminated=crashed | (next_state.time >= self.horizon),
            truncated=jnp.zeros((), bool),
            events=jnp.stack([crashed, before != after]),
        )

    def advance(self, state: HighwayState, action: Array, mu: Array, params: HighwayParams) -> HighwayState:
        """The next state on a road with friction coefficient `mu` ()."""
        vehicles, _ = advance(self.road, state.vehicles, state.drivers, state.time, action, mu, params.physics)
        return state.replace(vehicles=vehicles, time=state.time + 1)

    def rate(self, state: HighwayState, next_state: HighwayState, params: HighwayParams) -> Features:
        """The features of the reward.

        speed: the step's average forward speed, relative to `full_speed`.
        distance: bumper to bumper to the nearest car in the way, relative to `far`; 1 where there is none.
        relative_speed: 1 - the largest |difference of speeds| to another car, relative to `full_speed` and fading to nothing
            with the distance bumper to bumper, at `far`.
        lane: 1 on a lane's centre line, 0 between two lanes.
        """
        after, full = next_state.vehicles, params.full_speed
        x, y = after.x[0], after.y[0]
        speed = (x - state.vehicles.x[0]) * self.policy_hz / full
        ahead, aside = after.x[1:] - x, jnp.abs(after.y[1:] - y)
        in_the_way = (ahead > 0) & (aside < WIDTH)
        distance = jnp.min(jnp.where(in_the_way, ahead - LENGTH, jnp.inf)) / params.far
        nearness = 1 - jnp.clip((jnp.abs(ahead) - LENGTH) / params.far, 0.0, 1.0)
        difference = jnp.max(jnp.abs(after.speed[1:] - after.speed[0]) * nearness) / full
        lane = jnp.abs(y - LANE_WIDTH * vehicle.closest_lane(x, y, self.lanes)) / (LANE_WIDTH / 2)
        return Features(
            speed=jnp.clip(speed, 0.0, 1.0),
            distance=jnp.clip(distance, 0.0, 1.0),
            relative_speed=1 - jnp.clip(difference, 0.0, 1.0),
            lane=1 - jnp.clip(lane, 0.0, 1.0),
        )

    def reward(self, state: HighwayState, action: Array, next_state: HighwayState, params: HighwayParams) -> Array:
        """sum_i w_i f_i / sum_i w_i, less for a crash and for moving sideways; at most 1 a step.

        Moving by dy costs (lane_change_cost + swerve_cost (v / full_speed)^2) |dy| / LANE_WIDTH, with v before the step: what
        it takes from the tyres, and from who watches, grows with the speed squared.
        """
        del action  # what counts is where it led
        features, ratings = self.rate(state, next_state, params), params.ratings
        weights = jnp.stack([ratings.speed, ratings.distance, ratings.relative_speed, ratings.lane])
        sideways = jnp.abs(next_state.vehicles.y[0] - state.vehicles.y[0]) / LANE_WIDTH
        haste = (state.vehicles.speed[0] / params.full_speed) ** 2
        return (
            jnp.stack(features) @ weights / jnp.sum(weights)
            + params.crash_reward * next_state.vehicles.crashed[0]
            - (params.lane_change_cost + params.swerve_cost * haste) * sideways
        )

    def next_state_distribution(self, state: HighwayState, action: Array, params: HighwayParams) -> Mixture:
        """Equally likely outcomes of the road's friction, seen through the kernel."""
        friction = params.physics.friction
        nodes = jnp.asarray(friction_nodes(self.friction_points), friction.mean.dtype)
        outcome = lambda mu: self.perceive(self.advance(state, action, mu, params))
        outcomes = jax.vmap(outcome)(friction.mean + friction.sd * nodes)
        weights = jnp.full(self.friction_points, 1 / self.friction_points, outcomes.dtype)
        return Mixture(outcomes, weights, params.perception_width)

    def observe(self, state: HighwayState) -> Array:
        """Nothing saturates, and with the time it is all that matters until the car in front brakes.

        Ego: speed, lateral position, heading, lane and speed aimed at, share of the time gone. For every other car: distance
        ahead, lateral distance, speed relative to the ego's, and how hard it brakes by its own will.
        """
        vehicles, drivers = state.vehicles, state.drivers
        ego = jax.tree.map(lambda leaf: leaf[0], vehicles)
        others = jax.tree.map(lambda leaf: leaf[1:], vehicles)
        braking = -traffic.script(vehicles, drivers, state.time / self.policy_hz, self.road.dt)[1:]
        own = [
            ego.speed / SPEED_SCALE,
            ego.y / LANE_WIDTH,
            ego.heading / HEADING_SCALE,
            ego.target_lane.astype(ego.y.dtype),
            ego.target_speed / SPEED_SCALE,
            state.time.astype(ego.y.dtype) / self.horizon,
        ]
        theirs = [
            (others.x - ego.x) / GAP_SCALE,
            (others.y - ego.y) / LANE_WIDTH,
            (others.speed - ego.speed) / SPEED_SCALE,
            braking / BRAKING_SCALE,
        ]
        return jnp.concatenate([jnp.stack(own), jnp.stack(theirs, axis=1).reshape(-1)])

    def perceive(self, state: HighwayState) -> Array:
        """(3,): gap to the car that was in front, bumper to bumper, m; lateral position, m; speed, m/s."""
        vehicles = state.vehicles
        return jnp.stack([vehicles.x[1] - vehicles.x[0] - LENGTH, vehicles.y[0], vehicles.speed[0]])

    def perception_width(self, params: HighwayParams) -> Array:
        return params.perception_width

    def scene(self, state: HighwayState, params: HighwayParams) -> Scene:
        """The road around the ego, and the cars on it."""
        return scene.road_scene(state.vehicles, self.lanes)


@dataclasses.dataclass(frozen=True)
class ClassicHighway(Highway):
    """The same scenario with highway-env's own observation and reward.

    Its observation saturates, so that perception through it holds only while the car in front is the nearest and within 200 m.
    """

    observation_size = classic.ROWS * classic.COLUMNS
    observation_space = Bounds(-1.0, 1.0)

    def reward(self, state: HighwayState, action: Array, next_state: HighwayState, params: HighwayParams) -> Array:
        return classic.reward(next_state.vehicles, self.lanes)

    def observe(self, state: HighwayState) -> Array:
        return classic.observe(state.vehicles, self.lanes).reshape(-1)
