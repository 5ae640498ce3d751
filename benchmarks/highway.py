"""Policy steps a second in the two-car scene, compile time apart, beside highway-env itself; writes results/highway.md.

    make benchmark-highway ARGS="[--batch 256] [--steps 400] [--seconds 5] [--no-reference]"

Random actions, 15 simulation steps a policy step, a new start after a crash or 8 steps. The original (highway-env 1.12.1) runs in
an environment of its own, which the command makes on its first call.
"""

from __future__ import annotations

import argparse
import json
import os
import pathlib
import subprocess
import sys
import tempfile
import time

os.environ.setdefault("XLA_FLAGS", f"--xla_force_host_platform_device_count={len(os.sched_getaffinity(0))}")

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import NamedSharding, PartitionSpec

import peps_envs

FOLDER = pathlib.Path(__file__).parent
REFERENCE = "highway-env==1.12.1"
SCENE = {
    "lanes": 2, "sim_hz": 15, "policy_hz": 1, "target_speeds": [5.0 * step for step in range(7)],
    "vehicles": [
        {"kind": "ego", "lane": 1, "x": 100.0, "speed": 25.0},
        {"kind": "brake", "lane": 1, "x": 128.0, "speed": 25.0, "decel": 5.5, "t_brake": 0.9},
    ],
}  # fmt: skip


def ours(name: str, batch: int, steps: int, devices: int) -> tuple[float, float]:
    """Policy steps a second of `batch` scenes on each of `devices`, and the compilation's seconds."""
    environment, params, _ = peps_envs.make(name)

    def one(state, key):
        key_act, key_step, key_start = jax.random.split(key, 3)
        action = jax.random.randint(key_act, (), 0, environment.action_space.size)
        after = environment.step(key_step, state, action, params)
        start, _ = environment.reset(key_start, params)
        over = after.terminated | after.truncated
        return jax.tree.map(lambda new, old: jnp.where(over, new, old), start, after.state), after.reward

    def drive(keys):
        starts = jax.vmap(lambda key: environment.reset(key, params)[0])(jax.random.split(keys[0], batch))
        move = lambda states, key: jax.vmap(one)(states, jax.random.split(key, batch))
        _, rewards = jax.lax.scan(move, starts, jax.random.split(keys[0], steps))
        return jnp.mean(rewards)[None]

    mesh, spec = jax.make_mesh((devices,), ("scenes",), devices=jax.devices()[:devices]), PartitionSpec("scenes")
    keys = jax.device_put(jax.random.split(jax.random.key(0), devices), NamedSharding(mesh, spec))
    start = time.perf_counter()
    program = jax.jit(jax.shard_map(drive, mesh=mesh, in_specs=spec, out_specs=spec, check_vma=False))
    program = program.lower(keys).compile()
    compiled = time.perf_counter()
    jax.block_until_ready(program(keys))
    seconds = []
    for _ in range(3):
        begun = time.perf_counter()
        jax.block_until_ready(program(keys))
        seconds.append(time.perf_counter() - begun)
    return devices * batch * steps / float(np.median(seconds)), compiled - start


def theirs(seconds: float) -> float | None:
    """Policy steps a second of highway-env on one core; None where it can't be had, which one line explains."""
    home = FOLDER.parent / "build/highway-env"
    python = home / "bin/python"
    try:
        if not (home / "ready").exists():
            subprocess.run([sys.executable, "-m", "venv", home], check=True, capture_output=True)
            subprocess.run([python, "-m", "pip", "install", "--quiet", REFERENCE], check=True, capture_output=True)
            (home / "ready").touch()
        with tempfile.NamedTemporaryFile("w", suffix=".json") as scene:
            json.dump(SCENE, scene)
            scene.flush()
            command = [python, "-W", "ignore", FOLDER / "highway_env_scene.py", "rate", scene.name, str(seconds)]
            printed = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    except (subprocess.CalledProcessError, OSError) as error:
        print(f"{REFERENCE} is left out, because it could not be installed or run: {error}", file=sys.stderr)
        return None
    return float(printed.split()[-1])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--batch", type=int, default=256, help="scenes at a time on each core")
    parser.add_argument("--steps", type=int, default=400, help="policy steps of each")
    parser.add_argument("--seconds", type=float, default=5.0, help="how long highway-env runs")
    parser.add_argument("--no-reference", action="store_true", help="leave highway-env out")
    arguments = parser.parse_args()
    lines = ["| program | cores | policy steps a second | compilation, s |", "|---|---|---|---|"]
    for devices in sorted({1, jax.device_count()}):
        rate, compilation = ours("highway-rain", arguments.batch, arguments.steps, devices)
        lines.append(f"| peps_envs, highway-rain | {devices} | {rate:,.0f} | {compilation:.1f} |")
    reference = None if arguments.no_reference else theirs(arguments.seconds)
    if reference is not None:
        lines.append(f"| {REFERENCE} | 1 | {reference:,.1f} | |")
        lines += ["", f"{rate / reference:,.0f} times as fast; {arguments.batch} scenes at a time on each core."]
    (FOLDER / "results").mkdir(exist_ok=True)
    (FOLDER / "results/highway.md").write_text("\n".join(lines) + "\n")
    print("\n".join(lines))


if __name__ == "__main__":
    main()
