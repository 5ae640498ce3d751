"""The original highway-env (1.12.1), in an environment of its own that has it: how fast it steps, and what it does.

    python highway_env_scene.py rate SCENARIO.json SECONDS        prints policy steps and seconds, random actions; see `protocol`
    python highway_env_scene.py record SCENARIOS.json OUT.npz     writes what `peps_envs.highway.replay` should return

A scenario is a recording's `meta`; for `record`, a dictionary of names, each with `meta` and `actions`.
"""

import json
import sys
import time

import numpy as np
import protocol
from highway_env.envs.highway_env import HighwayEnv
from highway_env.vehicle.behavior import IDMVehicle
from highway_env.vehicle.kinematics import Vehicle


class Braking(Vehicle):
    """Drives straight on, and from `t_brake` brakes until it stands."""

    deceleration, onset, frequency, steps = 0.0, np.inf, 15, 0

    def act(self, action=None):
        # simulation times are multiples of the step that may round either way
        brakes = self.steps >= self.onset * self.frequency - 1e-6
        self.action = {
            "steering": 0.0,
            "acceleration": -min(self.deceleration, self.speed * self.frequency) if brakes else 0.0,
        }
        self.steps += 1


def make_environment(meta: dict) -> HighwayEnv:
    """highway-env, with the scenario's clock and road and nobody on it yet."""
    actions = {"type": "DiscreteMetaAction", "target_speeds": meta["target_speeds"]}
    environment = HighwayEnv(
        {
            "lanes_count": meta["lanes"],
            "simulation_frequency": meta["sim_hz"],
            "policy_frequency": meta["policy_hz"],
            "vehicles_count": 0,
            "duration": np.inf,
            "action": actions,
        }
    )
    environment.reset(seed=0)
    return environment


def populate(environment: HighwayEnv, meta: dict) -> list[Vehicle]:
    """Puts the scenario's vehicles on the road, instead of whoever is there."""
    road, vehicles = environment.road, []
    road.vehicles.clear()
    for spec in meta["vehicles"]:
        place = (road, [spec["x"], 4 * spec["lane"] + spec.get("lat", 0.0)], spec.get("heading", 0.0), spec["speed"])
        if spec["kind"] == "ego":
            vehicle = environment.action_type.vehicle_class(*place, target_speed=spec.get("target_speed"))
            environment.controlled_vehicles = [vehicle]
        elif spec["kind"] == "idm":
            changes, timer = spec.get("lane_change", False), spec.get("timer")
            vehicle = IDMVehicle(*place, target_speed=spec.get("target_speed"), enable_lane_change=changes, timer=timer)
        elif spec["kind"] == "brake":
            vehicle = Braking(*place)
            vehicle.frequency, vehicle.deceleration = meta["sim_hz"], spec.get("decel", 0.0)
            vehicle.onset = spec.get("t_brake", 0.0)
        else:
            vehicle = Vehicle(*place)
        road.vehicles.append(vehicle)
        vehicles.append(vehicle)
    environment.action_type.controlled_vehicle = environment.vehicle
    environment.observation_type.observer_vehicle = environment.vehicle
    return vehicles


def rate(meta: dict, seconds: float, wait: bool, horizon: int = 8) -> None:
    """Policy steps for about `seconds`, with random actions and a new start after a crash or `horizon` steps."""
    environment, random = make_environment(meta), np.random.default_rng(0)
    populate(environment, meta)
    preparation = protocol.get_ready(wait)
    steps = age = 0
    start = time.perf_counter()
    while time.perf_counter() - start < seconds:
        _, _, crashed, _, _ = environment.step(int(random.integers(5)))
        steps, age = steps + 1, age + 1
        if crashed or age == horizon:
            populate(environment, meta)
            age = 0
    protocol.report(steps, time.perf_counter() - start, preparation)


def record(meta: dict, actions: list[int]) -> dict[str, np.ndarray]:
    """The arrays of a recording: the start and every simulation step, and every policy step."""
    environment = make_environment(meta)
    vehicles = populate(environment, meta)
    nobody = [np.nan, np.nan]
    aims = lambda car: [car.target_lane_index[2], car.target_speed] if hasattr(car, "target_lane_index") else nobody
    look = {
        "state": lambda car: [*car.position, car.heading, car.speed],
        "target": aims,
        "lane": lambda car: car.lane_index[2],
        "crashed": lambda car: car.crashed,
        "timer": lambda car: getattr(car, "timer", np.nan),
        "impact": lambda car: [0.0, 0.0] if car.impact is None else list(car.impact),
    }
    rows = {name: [[see(car) for car in vehicles]] for name, see in look.items()}
    control = []
    move = environment.road.step

    def watched(dt: float) -> None:
        move(dt)
        control.append([[car.action["steering"], car.action["acceleration"]] for car in vehicles])
        for name, see in look.items():
            rows[name].append([see(car) for car in vehicles])

    environment.road.step = watched
    observations, results = [environment.observation_type.observe()], []
    for action in actions:
        observation, reward, terminated, _, _ = environment.step(action)
        observations.append(observation)
        results.append((reward, terminated))
    types = {"lane": np.int32, "crashed": bool}
    return {name: np.asarray(values, types.get(name, float)) for name, values in rows.items()} | {
        "meta": json.dumps(meta),
        "actions": np.asarray(actions, np.int32),
        "control": np.asarray(control, float),
        "obs": np.asarray(observations),
        "reward": np.asarray([reward for reward, _ in results], float),
        "terminated": np.asarray([terminated for _, terminated in results], bool),
    }


def main() -> None:
    task, source, target = (argument for argument in sys.argv[1:] if argument != "--wait")
    with open(source, encoding="utf-8") as file:
        content = json.load(file)
    if task == "rate":
        rate(content, float(target), "--wait" in sys.argv)
    else:
        arrays = {
            f"{name}/{key}": values
            for name, scenario in content.items()
            for key, values in record(scenario["meta"], scenario["actions"]).items()
        }
        np.savez_compressed(target, scenarios=np.array(list(content)), **arrays)


if __name__ == "__main__":
    main()
