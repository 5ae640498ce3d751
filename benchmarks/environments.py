"""Environments alone: random actions, a new start after an episode's end, on all cores."""

from __future__ import annotations

import json
import tempfile
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import peer
import timing

import peps_envs

NAVIGATION = ("nav-d1", "nav-d2", "nav-d3", "nav-d4")
HIGHWAY = "highway-rain"
TOLERANCE = 1e-5  # between the NumPy environment and the JAX one, which has 32-bit floats
SCENE = {  # of highway-env: `highway-rain`'s
    "lanes": 2, "sim_hz": 15, "policy_hz": 1, "target_speeds": [5.0 * step for step in range(7)],
    "vehicles": [
        {"kind": "ego", "lane": 1, "x": 100.0, "speed": 25.0},
        {"kind": "brake", "lane": 1, "x": 128.0, "speed": 25.0, "decel": 5.5, "t_brake": 0.9},
    ],
}  # fmt: skip


def random_action(space: peps_envs.ActionSpace, key: jax.Array) -> jax.Array:
    if isinstance(space, peps_envs.Discrete):
        return jax.random.randint(key, (), 0, space.size)
    return jax.random.uniform(key, (space.size,), minval=-1.0, maxval=1.0)


def ours(names: tuple[str, ...], batch: int, steps: int) -> dict[str, dict[str, float]]:
    """Steps a second of `batch` environments on each device, for environments that share one program."""
    tasks = [peps_envs.make(name) for name in names]
    environment = tasks[0].environment

    def one(state: Any, key: jax.Array, params: Any) -> tuple[Any, jax.Array]:
        key_act, key_step, key_start = jax.random.split(key, 3)
        after = environment.step(key_step, state, random_action(environment.action_space, key_act), params)
        start, _ = environment.reset(key_start, params)
        over = after.terminated | after.truncated
        state = jax.tree.map(lambda new, old: jnp.where(over, new, old), start, after.state)
        return state, after.reward + jnp.sum(after.observation)  # of all that a step makes, nothing is left out

    def run(key: jax.Array, params: Any) -> jax.Array:
        keys = jax.random.split(key, batch)
        starts = jax.vmap(lambda key: environment.reset(key, params)[0])(keys)
        move = lambda states, key: jax.vmap(one, in_axes=(0, 0, None))(states, jax.random.split(key, batch), params)
        return jnp.mean(jax.lax.scan(move, starts, jax.random.split(key, steps))[1])

    keys, rows = timing.spread(jax.random.split(jax.random.key(0), jax.device_count())), {}
    copies = lambda params: timing.spread(
        jax.tree.map(lambda leaf: jnp.stack([jnp.asarray(leaf)] * jax.device_count()), params)
    )
    program, compilation = timing.compiled(run, keys, copies(tasks[0].params))
    for name, task in zip(names, tasks, strict=True):
        seconds = timing.seconds(program, keys, copies(task.params))
        rows[name] = {"rate": jax.device_count() * batch * steps / seconds, "compilation": compilation}
    return rows


def transitions_of_d1(number: int) -> dict[str, list]:
    """Deterministic steps of D1 from everywhere, as the JAX environment makes them."""
    task = peps_envs.make("nav-d1")
    key_place, key_action, key_step = jax.random.split(jax.random.key(0), 3)
    start, _ = task.environment.reset(key_step, task.params)
    places = jax.random.uniform(key_place, (number, 2), maxval=6.0)
    actions = jax.random.uniform(key_action, (number, 2), minval=-1.5, maxval=1.5)
    step = lambda place, action: task.environment.step(key_step, start.replace(position=place), action, task.params)
    after = jax.vmap(step)(places, actions)
    arrays = {"position": places, "action": actions, "observation": after.observation, "reward": after.reward,
              "terminated": after.terminated}  # fmt: skip
    return {name: np.asarray(values).tolist() for name, values in arrays.items()}


def difference() -> float:
    """The largest one between the NumPy environment's steps and the JAX environment's.

    Raises:
      ValueError: they are not the same environment.
    """
    found = json.loads(
        _with_file(transitions_of_d1(500), lambda path: peer.call("sb3", "numpy_navigation.py", "check", path))
    )
    if not found["difference"] < TOLERANCE:
        raise ValueError(f"the NumPy environment differs from nav-d1 by {found['difference']}: bring it up to date")
    return found["difference"]


def _with_file(content: Any, use: Any) -> Any:
    with tempfile.NamedTemporaryFile("w", suffix=".json", encoding="utf-8") as file:
        json.dump(content, file)
        file.flush()
        return use(file.name)


def measure(quick: bool) -> dict[str, Any]:
    """Rates of every environment, ours and others'; `missing` says why one isn't there."""
    rates = ours(NAVIGATION, *((64, 20) if quick else (1_024, 1_000)))
    rates |= ours((HIGHWAY,), *((8, 10) if quick else (256, 400)))
    cores, seconds = len(peer.CORES), 0.5 if quick else 4.0
    others: dict[str, Any] = {}
    record = {"rates": rates, "others": others}
    numpy = lambda count: peer.measure("sb3", "numpy_navigation.py", ("rate", count, seconds), cores)
    scene = lambda: _with_file(
        SCENE, lambda path: peer.measure("highway", "highway_env_scene.py", ("rate", path, seconds), cores)
    )
    try:
        record["difference"] = difference()
        others["NumPy, a thousand at a time"] = {"rate": numpy(1_000).rate, "environment": "nav-d1"}
        others["Gymnasium and NumPy"] = {"rate": numpy(1).rate, "environment": "nav-d1"}
    except peer.Missing as error:
        others["Gymnasium and NumPy"] = {"missing": str(error), "environment": "nav-d1"}
    try:
        others["highway-env 1.12.1"] = {"rate": scene().rate, "environment": HIGHWAY}
    except peer.Missing as error:
        others["highway-env 1.12.1"] = {"missing": str(error), "environment": HIGHWAY}
    return record
