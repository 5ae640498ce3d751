"""Random scenes of highway-env 1.12.1 beside `peps_envs.highway.replay`: whether they are the same arrays.

    python benchmarks/highway_fuzz.py [--scenes 300] [--seed 0]

Scenes have all kinds of vehicles, exact ties of places, headings all around with -pi and pi among them, and speeds from -10 to 60
m/s. Writes benchmarks/results/highway_fuzz.md, and the scenes that differ beside it, if any do.
"""

from __future__ import annotations

import argparse
import collections
import json
import subprocess
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
import peer

from peps_envs.highway.replay import replay
from peps_jax.storage.tables import markdown

ROOT = Path(__file__).parent
OUT = ROOT / "results" / "highway_fuzz.md"
TOLERANCE = 1e-8  # of states and commands; observations are of 32 bits, and compared to 3e-7
CLOCKS = ((5, 1), (10, 1), (15, 1), (10, 5), (15, 5), (15, 3))  # simulation and policy steps in a second
HEADINGS = (0.0, np.pi, -np.pi, np.pi / 2, -np.pi / 2)


def scene(random: np.random.Generator) -> dict[str, Any]:
    """A random scene with its ego's actions."""
    lanes = int(random.integers(1, 5))
    simulation, policy = CLOCKS[random.integers(len(CLOCKS))]
    number = int(random.integers(1, 8))
    grid = [20.0, 25.0, 30.0] if random.random() < 0.7 else [10.0, 20.0, 30.0, 40.0]
    vehicles, places = [], []
    for index in range(number):
        kind = "ego" if index == 0 else str(random.choice(["brake", "idm", "idm", "plain"]))
        wild = random.random() < 0.3
        x = float(random.choice(places)) if places and random.random() < 0.15 else float(random.uniform(-20, 250))
        places.append(x)
        fast = random.uniform(-10, 60) if wild else random.uniform(5, 35)
        spec = dict(kind=kind, x=x, lane=int(random.integers(lanes)), speed=float(fast))
        if wild:
            spec["lat"] = float(random.uniform(-3, 3))
            turned = random.random() < 0.5
            spec["heading"] = float(random.choice(HEADINGS) if turned else random.uniform(-np.pi, np.pi))
        if kind == "brake":
            spec |= dict(decel=float(random.uniform(1, 9)), t_brake=float(random.uniform(0, 3)))
        if kind == "idm":
            spec |= dict(lane_change=bool(random.random() < 0.6), target_speed=float(random.uniform(15, 35)))
            if random.random() < 0.5:
                spec["timer"] = float(random.uniform(0.05, 1.5))
        vehicles.append(spec)
    meta = dict(lanes=lanes, sim_hz=simulation, policy_hz=policy, target_speeds=grid, vehicles=vehicles)
    return {"meta": meta, "actions": random.integers(0, 5, int(random.integers(2, 13))).tolist()}


def originals(scenes: dict[str, Any], python: str) -> Any:
    """What highway-env does in `scenes`, by `python`, which has it."""
    with tempfile.TemporaryDirectory() as folder:
        source, target = Path(folder) / "scenes.json", Path(folder) / "recorded.npz"
        source.write_text(json.dumps(scenes), encoding="utf-8")
        script = ROOT / "peers" / "highway_env_scene.py"
        subprocess.run([python, script, "record", source, target], check=True, cwd=script.parent)
        with np.load(target) as stored:
            return {name: stored[name] for name in stored.files}


def difference(scenario: dict[str, Any], name: str, recorded: dict[str, np.ndarray]) -> tuple[str, float]:
    """ "equal", "refused: why" or the first array that differs, and by how much states and commands do."""
    try:
        found = replay(scenario["meta"], scenario["actions"])
    except ValueError as error:
        return "refused, because rounding decides" if "rounding" in str(error) else "refused: a plain car too fast", 0.0
    furthest = 0.0
    for key in ("state", "control", "target", "lane", "crashed", "timer", "impact", "obs", "reward", "terminated"):
        ours, theirs = np.asarray(found[key], float), np.asarray(recorded[f"{name}/{key}"], float)
        if not np.array_equal(np.isnan(ours), np.isnan(theirs)):
            return f"{key} is there or not", np.inf
        apart = float(np.nanmax(np.abs(ours - theirs), initial=0.0))
        if apart > (3e-7 if key == "obs" else TOLERANCE):
            return f"{key} differs", apart
        if key in ("state", "control"):
            furthest = max(furthest, apart)
    return "equal", furthest


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--scenes", type=int, default=300)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--python", help="that has highway-env 1.12.1; by default one is set up")
    parser.add_argument("--out", type=Path, default=OUT)
    given = parser.parse_args(arguments)
    random = np.random.default_rng(given.seed)
    scenes = {f"scene {number}": scene(random) for number in range(given.scenes)}
    recorded = originals(scenes, given.python or str(peer.python_of("highway")))
    kinds, furthest, differing = collections.Counter(), 0.0, {}
    with jax.enable_x64(True):
        for number, (name, scenario) in enumerate(scenes.items()):
            if number % 20 == 0:
                jax.clear_caches()  # hardly two scenes share a program
            kind, apart = difference(scenario, name, recorded)
            kinds[kind] += 1
            if kind == "equal":
                furthest = max(furthest, apart)
            elif not kind.startswith("refused"):
                differing[name] = scenario | {"what": kind, "apart": apart}
                print(name, kind, apart, flush=True)
    lines = [f"{given.scenes} random scenes, seed {given.seed}: states and commands of the equal ones are at most",
             f"{furthest:.1e} apart in every simulation step.", "",
             markdown(["outcome", "scenes"], [[kind, str(number)] for kind, number in kinds.most_common()])]  # fmt: skip
    given.out.write_text("\n".join(lines), encoding="utf-8")
    print("\n".join(lines))
    if differing:
        given.out.with_suffix(".json").write_text(json.dumps(differing, indent=1), encoding="utf-8")


if __name__ == "__main__":
    main()
