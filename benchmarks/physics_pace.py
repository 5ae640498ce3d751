"""How PEPS keeps pace with the physics, and what it then learns; writes results/physics_pace.md.

    python benchmarks/physics_pace.py [--env mjx-box] [--seeds 6]

The same simulator is stepped in every one of `ways`; what changes is where the belief is stepped too, and how many steps share a
gradient step.
"""

from __future__ import annotations

import argparse
import pathlib

import jax
import numpy as np
import physics

from peps_jax import Config
from peps_jax.analysis.intervals import interquartile_mean
from peps_jax.command_line import use_every_core
from peps_jax.execution.program import program
from peps_jax.reproduce.physics import SETTINGS
from peps_jax.storage.tables import markdown

OUT = pathlib.Path(__file__).parent / "results" / "physics_pace.md"
EPISODES = 20
HALF = {"updates_per_step": 0.25, "dynamics_updates": 10, "surrogate_updates": 20}
HARDLY = {"updates_per_step": 0.0025, "dynamics_updates": 1, "surrogate_updates": 1}


def ways(env: str) -> dict[str, dict[str, float]]:
    """Settings beside the defaults, by what they are called."""
    table = SETTINGS.get(env, {})
    return {
        "the defaults": {},
        "half of all updates": HALF,
        "the table's updates, the belief stepped everywhere": table | {"watched_every": 1},
        "as in the table": table,
        "next to no updates, the belief stepped everywhere": HARDLY,
        "next to no updates": table | HARDLY,
    }


_NOTE = """\
Rates are environment steps a second of whole trainings on {devices} devices, compilation apart; "of the physics" compares with
what the physics alone makes with as many environments, before and after. "Seconds" are those of one training on one core. Scores
are interquartile means over {seeds} seeds, {episodes} episodes each.
"""


def row(env: str, way: str, changes: dict[str, float], seeds: int) -> list[str]:
    """A way's line of the table."""
    config = Config(env=env, **changes)
    configs = [config.replace(seed=seed) for seed in range(seeds)]
    before = physics.alone(env, config.num_envs)
    compiled, _ = program(config, seeds, EPISODES, tuple(jax.devices()))
    runs, times = compiled.run(configs, EPISODES)
    rate = seeds * config.num_rounds * config.steps_per_round / times.run
    share = 2 * rate / (before + physics.alone(env, config.num_envs))
    over_seeds = lambda name: np.array([np.mean(getattr(run.evaluation, name)) for run in runs])
    iqm = lambda name: f"{float(interquartile_mean(over_seeds(name)[:, None])):.1f}"
    arrive = f"{np.sum(over_seeds('goal_reached') == 1)} of {seeds}"
    seconds = times.run * jax.device_count() / seeds
    made = [env, way, f"{rate:,.0f}", f"{share:.0%}", f"{seconds:.1f}", arrive, iqm("return_"), iqm("explicability")]
    print(*made, sep=" | ", flush=True)
    return made


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--env", default=physics.TASKS[0])
    parser.add_argument("--seeds", type=int, default=6)
    args = parser.parse_args()
    use_every_core()
    rows = [row(args.env, way, changes, args.seeds) for way, changes in ways(args.env).items()]
    head = ["task", "PEPS", "steps a second", "of the physics", "seconds", "arrive", "return", "explicability"]
    text = f"{markdown(head, rows)}\n{_NOTE.format(devices=jax.device_count(), seeds=args.seeds, episodes=EPISODES)}"
    OUT.write_text(text, encoding="utf-8")
    print(text)


if __name__ == "__main__":
    main()
