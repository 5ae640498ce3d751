"""Scenarios of highway-env, replayed: the same arrays as a recording of the original."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from peps_envs.highway import classic, traffic, vehicle
from peps_envs.highway.simulation import Physics, Road, advance, highway_env
from peps_envs.highway.traffic import Drivers
from peps_envs.highway.vehicle import LANE_WIDTH, Control, Vehicles

KINDS = ("ego", "brake", "idm", "plain")
GAP = 1e-9  # m, within which cars touch or don't: an earlier collision parts them to a gap of 0 up to rounding
BLUR = 1e-12  # by which gains and habits are turned up and down, some ten thousand times what rounding does
SPREAD = 1e-6  # by which the same scene may differ then: rounding alone makes a ten thousandth of it


@partial(jax.jit, static_argnums=0)
def _policy_step(road: Road, vehicles: Vehicles, drivers: Drivers, step: int, action: int, physics: Physics):
    vehicles, trace = advance(road, vehicles, drivers, step, action, physics.friction.mean, physics)
    return vehicles, trace, classic.observe(vehicles, road.lanes), classic.reward(vehicles, road.lanes)


def _start_timer(spec: Mapping[str, Any]) -> float:
    """Seconds since a driver last considered a lane change; where nothing or 0 is said, highway-env spreads them by place."""
    position = spec["x"] + LANE_WIDTH * spec["lane"] + spec.get("lat", 0.0)
    return spec.get("timer") or position * np.pi % traffic.CHANGE_DELAY


def _timers(meta: Mapping[str, Any], wait: np.ndarray) -> np.ndarray:
    """(S+1, N) s, the timers that `wait` (S+1, N) counts steps of; nan for those who don't follow the IDM."""
    follows = [spec["kind"] == "idm" for spec in meta["vehicles"]]
    timers = np.full(wait.shape, np.nan)
    timers[0, follows] = [_start_timer(spec) for spec in meta["vehicles"] if spec["kind"] == "idm"]
    for step in range(1, len(wait)):
        restarted = wait[step] != wait[step - 1] - 1
        timers[step] = np.where(restarted, 0.0, timers[step - 1]) + 1 / meta["sim_hz"]
    return timers


def place(meta: Mapping[str, Any]) -> tuple[Vehicles, Drivers]:
    """The vehicles and drivers that a scenario starts with.

    Raises:
      ValueError: a kind of vehicle that doesn't exist, an ego elsewhere than first, or a plain car that is too fast.
    """
    kinds = [spec["kind"] for spec in meta["vehicles"]]
    for kind in kinds:
        if kind not in KINDS:
            raise ValueError(f"vehicle kind {kind!r} is unknown: known are {', '.join(KINDS)}")
    if [kind == "ego" for kind in kinds] != [index == 0 for index in range(len(kinds))]:
        raise ValueError(f"kinds {', '.join(kinds)}: the first vehicle has to be the ego, and no other")
    for index, spec in enumerate(meta["vehicles"]):
        if spec["kind"] == "plain" and abs(spec["speed"]) > vehicle.MAX_SPEED:
            raise ValueError(
                f"vehicle {index} is plain and drives at {spec['speed']} m/s: highway-env would repeat the command that first "
                f"slows it until it drives backwards, where here it is slowed to {vehicle.MAX_SPEED:g} m/s; choose at most that, "
                "or the kind 'brake'"
            )
    dt, grid = 1 / meta["sim_hz"], np.asarray(meta["target_speeds"], float)
    rows = []
    for kind, spec in zip(kinds, meta["vehicles"], strict=True):
        x, y = float(spec["x"]), LANE_WIDTH * spec["lane"] + spec.get("lat", 0.0)
        target = spec.get("target_speed") or spec["speed"]
        if kind == "ego":
            target = grid[int(vehicle.nearest_speed(np.asarray(target, float), grid))]
        brakes = kind == "brake" and "decel" in spec
        rows.append(
            dict(
                x=x, y=y, heading=float(spec.get("heading", 0.0)), speed=float(spec["speed"]),
                target_speed=float(target) if kind in ("ego", "idm") else 0.0,
                wait=traffic.steps_until(_start_timer(spec), dt), follows=kind == "idm",
                changes=bool(spec.get("lane_change", False)), deceleration=float(spec["decel"]) if brakes else 0.0,
                onset=float(spec.get("t_brake", 0.0)) if brakes else np.inf,
            )
        )  # fmt: skip
    column = {name: np.array([row[name] for row in rows]) for name in rows[0]}
    zeros, never = np.zeros(len(rows)), np.zeros(len(rows), bool)
    vehicles = Vehicles(
        **{name: column[name] for name in ("x", "y", "heading", "speed", "target_speed")},
        x_rest=zeros, speed_rest=zeros, wait=column["wait"].astype(np.int32),
        impact_x=zeros, impact_y=zeros, struck=never, crashed=never,
        target_lane=np.asarray(vehicle.closest_lane(column["x"], column["y"], meta["lanes"])),
    )  # fmt: skip
    drivers = Drivers(**{name: column[name] for name in ("follows", "changes", "deceleration", "onset")})
    return jax.tree.map(jnp.asarray, (vehicles, drivers))


def _drive(
    road: Road, start: tuple[Vehicles, Drivers], actions: np.ndarray, physics: Physics
) -> tuple[Vehicles, Control, dict[str, np.ndarray]]:
    """What `actions` (P,) lead to: vehicles (S+1, N), controls (S, N), and the ego's obs, reward and terminated by policy steps."""
    vehicles, drivers = start
    traces, seen = [], {"obs": [classic.observe(vehicles, road.lanes)], "reward": [], "terminated": []}
    for step, action in enumerate(actions):
        vehicles, trace, observation, reward = _policy_step(road, vehicles, drivers, step, action, physics)
        traces.append(trace)
        for name, value in zip(seen, (observation, reward, vehicles.crashed[0]), strict=True):
            seen[name].append(value)
    moved, control = jax.tree.map(lambda *leaves: np.concatenate(leaves), *traces)
    history = jax.tree.map(lambda first, later: np.concatenate([first[None], later]), start[0], moved)
    return history, control, {name: np.stack(values) for name, values in seen.items()}


def _state(history: Vehicles) -> np.ndarray:
    """(S+1, N, 4): x, y, heading and speed."""
    return np.stack([history.x, history.y, history.heading, history.speed], -1)


def _check_decided(meta: Mapping[str, Any], road: Road, actions: np.ndarray) -> None:
    """Raises ValueError where the last bits of a sum decide what happens: other programs, highway-env too, round them otherwise.

    Cars that just touch, and a car that steers while it comes to a stand, make such scenes. They are driven twice in double
    precision, once with wider contacts and gains turned up, once with narrower ones and gains turned down.
    """
    with jax.enable_x64(True):
        start, states, crashed = place(meta), [], []
        physics = highway_env(meta["target_speeds"])
        for factor, contact in ((1 + BLUR, GAP), (1 - BLUR, -GAP)):
            gains, habits = jax.tree.map(partial(jnp.multiply, factor), (physics.gains, physics.habits))
            blurred = physics.replace(gains=gains, habits=habits, contact=jnp.asarray(contact))
            history, *_ = _drive(road, start, actions, blurred)
            states.append(_state(history))
            crashed.append(history.crashed)
    apart = (np.abs(states[0] - states[1]).max(-1) > SPREAD) | (crashed[0] != crashed[1])
    if apart.any():
        step, car = np.argwhere(apart)[0]
        raise ValueError(
            f"vehicle {car} is at {step / meta['sim_hz']:g} s where rounding decides what it does next, so that highway-env itself "
            "would do otherwise on another machine; choose a shorter scene or another start"
        )


def replay(meta: Mapping[str, Any], actions: Sequence[int]) -> dict[str, np.ndarray]:
    """What happens in a scenario, in the precision that JAX is set to.

    Args:
      meta: the scenario, as `parity.npz` describes it: lanes, sim_hz, policy_hz, target_speeds and vehicles.
      actions: (P,) the ego's meta-actions.

    Returns:
      Arrays by the names of a recording, over S simulation steps of N vehicles: state (S+1, N, 4), control (S, N, 2),
      target (S+1, N, 2), lane, crashed and timer (S+1, N), impact (S+1, N, 2), obs (P+1, 5, 5), reward and terminated (P,).

    Raises:
      ValueError: a scenario that `place` refuses, or one in which rounding decides what happens.
    """
    road = Road(
        lanes=meta["lanes"], simulation_hz=meta["sim_hz"], policy_hz=meta["policy_hz"],
        follows=any(spec["kind"] == "idm" for spec in meta["vehicles"]),
    )  # fmt: skip
    actions = np.asarray(actions, np.int32)
    start = place(meta)
    _check_decided(meta, road, actions)
    history, control, seen = _drive(road, start, actions, highway_env(meta["target_speeds"]))
    drivers = start[1]
    steers = np.asarray(drivers.follows) | (np.arange(len(drivers.follows)) == 0)
    target = np.stack([history.target_lane, history.target_speed], -1)
    return {
        "state": _state(history),
        "control": np.stack([np.asarray(vehicle.steering_angle(control.slip)), control.acceleration], -1),
        "target": np.where(steers[None, :, None], target, np.nan),
        "lane": np.asarray(vehicle.closest_lane(history.x, history.y, road.lanes)),
        "crashed": history.crashed,
        "timer": _timers(meta, history.wait),
        "impact": np.stack([history.impact_x, history.impact_y], -1),
        "actions": actions,
        **seen,
    }
