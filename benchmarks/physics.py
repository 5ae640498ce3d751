"""Physics tasks: PEPS, set as in the evaluation, beside the physics alone and SAC; writes benchmarks/results/physics_speed.md.

    python benchmarks/physics.py [--envs mjx-box ...]

Rates are environment steps a second, on all devices at once, with as many environments side by side as a training has; what the
physics makes alone is measured in the same process as the trainings.
"""

from __future__ import annotations

import argparse
import pathlib

import environments
import jax
import jax.numpy as jnp
import timing

from peps_envs import registry
from peps_jax import Config
from peps_jax.command_line import use_every_core
from peps_jax.execution.devices import stack
from peps_jax.execution.program import advance, begin, shared
from peps_jax.reproduce.physics import SETTINGS
from peps_jax.storage.tables import markdown

OUT = pathlib.Path(__file__).parent / "results" / "physics_speed.md"
TASKS = tuple(f"mjx-{module}" for module in registry.PHYSICS)
ROUNDS = 10  # of a training that are timed
STEPS = 500  # of the physics alone
_NOTE = """\
Environment steps a second on {devices} devices, {number} environments on each; the physics alone is measured before and after
the trainings. PEPS steps the belief besides where the human watches, and SAC has as many updates for a step as PEPS.
"""


def alone(env: str, num_envs: int) -> float:
    """Steps a second of the physics and nothing else."""
    return environments.ours((env,), num_envs, STEPS)[env]["rate"]


def training(config: Config) -> tuple[float, float]:
    """Steps a second of `config`'s training after its random start, one on each device, and seconds of compilation."""
    configs = [shared(config.replace(seed=seed)) for seed in range(jax.device_count())]
    warm = configs[0].warmup_rounds
    batch = timing.spread(stack(configs))
    states, _ = timing.compiled(begin, batch)
    go_on = lambda state, config: advance(state, jnp.array([warm, warm + ROUNDS]), config)[0]
    state = states(batch)
    program, compilation = timing.compiled(go_on, state, batch)
    steps = jax.device_count() * ROUNDS * configs[0].steps_per_round
    return steps / timing.seconds(program, state, batch), compilation


def row(env: str) -> list[str]:
    """A task's line of the table."""
    before, settings = alone(env, Config().num_envs), SETTINGS.get(env, {})
    (sac, sac_compiles), (peps, peps_compiles) = (
        training(Config(env=env, method=name, **settings)) for name in ("sac", "peps")
    )
    physics = (before + alone(env, Config().num_envs)) / 2
    return [env, f"{physics:,.0f}", f"{sac:,.0f}", f"{peps:,.0f}", f"{peps / physics:.0%}", f"{peps / sac:.0%}",
            f"{sac_compiles:.0f}", f"{peps_compiles:.0f}", f"{peps_compiles / sac_compiles:.1f}"]  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--envs", nargs="+", default=list(TASKS))
    args = parser.parse_args()
    use_every_core()
    rows = [row(env) for env in args.envs]
    head = [
        "task",
        "physics alone",
        "SAC",
        "PEPS",
        "PEPS of the physics",
        "PEPS of SAC",
        "SAC compiles, s",
        "PEPS, s",
        "times as long",
    ]
    note = _NOTE.format(devices=jax.device_count(), number=Config().num_envs)
    text = f"{markdown(head, rows)}\n{note}"
    OUT.write_text(text, encoding="utf-8")
    print(text)


if __name__ == "__main__":
    main()
