"""Where a round's time goes: each part of it as a program of its own, on what half a training leaves."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import timing
from training import WIDTHS, seeds_of, shortened

from peps_jax import Config, methods, rollout
from peps_jax.execution import batches
from peps_jax.learning import dynamics, replay, sac
from peps_jax.methods import peps, preference_based
from peps_jax.preferences import synthetic_human
from peps_jax.train import TrainingState, collect_and_ask, improve, init, run_round, run_rounds, value
from peps_jax.trajectory import Preferences, Trajectory, Transition

PARTS = {  # as the text calls them
    "collect": "collecting",
    "ask": "choosing and answering queries",
    "fit_dynamics": "fitting T_A",
    "fit_surrogate": "fitting r̂",
    "value": "r̂ and entropies of the minibatches",
    "improve": "SAC's updates",
}
AT_ONCE = "value at once"  # tried: r-hat and entropies of all of a round's minibatches in one piece


def prepare(config: Config) -> tuple[TrainingState, Trajectory, Preferences | None, Transition]:
    """A training's state half way, and what the parts of its next round hand to one another."""
    index, key = config.num_rounds // 2, jax.random.key(1)
    state, _ = run_rounds(init(config), jnp.arange(index), config)
    act = lambda observation, key, time: sac.act(state.agents, observation, key, config)[0]
    _, trajectory, _ = rollout.collect(state.actors, act, key, config)
    queries = methods.get(config.method).ask(state.knowledge, trajectory, key, config)
    preferences = None if queries is None else synthetic_human.SYNTHETIC.answer(key, queries, config)
    shape = (config.updates_per_round, config.batch_size)
    return state, trajectory, preferences, replay.sample(state.replay, key, shape, index * config.steps_per_round)


def parts(structure: Config) -> dict[str, Callable[..., Any]]:
    """What a round of PEPS does, by the names of `PARTS`; of SAC, what it does of that; `AT_ONCE`; and the `whole`."""
    index, key = jnp.int32(structure.num_rounds // 2), jax.random.key(1)
    filled = (index + 1) * structure.steps_per_round
    plain = lambda config: config.replace(method="sac")  # asks nothing, and takes rewards as they are

    def collect(state, trajectory, preferences, batches, config):
        return collect_and_ask(state, index, plain(config))

    def ask(state, trajectory, preferences, batches, config):
        queries = methods.get(config.method).ask(state.knowledge, trajectory, key, config)
        return synthetic_human.SYNTHETIC.answer(key, queries, config)

    def fit_dynamics(state, trajectory, preferences, batches, config):
        return dynamics.fit(state.knowledge.dynamics, state.replay, filled, key, config)

    def fit_surrogate(state, trajectory, preferences, batches, config):
        return preference_based.learn(
            state.knowledge.surrogate, state.replay, filled, preferences, index, (key, key), config
        )

    def value_parts(state, trajectory, preferences, batches, config):
        return value(peps.reward, state.knowledge, batches, config)

    def value_at_once(state, trajectory, preferences, batches, config):
        return peps.reward(state.knowledge, batches, config)

    def update(state, trajectory, preferences, batches, config):
        return improve(state, index, key, plain(config))

    def whole(state, trajectory, preferences, batches, config):
        return run_round(state, index, config)

    learned = {
        "ask": ask,
        "fit_dynamics": fit_dynamics,
        "fit_surrogate": fit_surrogate,
        "value": value_parts,
        AT_ONCE: value_at_once,
    }
    return {"collect": collect} | (learned if structure.method == "peps" else {}) | {"improve": update, "whole": whole}


def seconds_of_parts(config: Config, repeats: int) -> dict[str, float]:
    """Seconds of each part of one cell's round, while all devices do the same."""
    each = 4  # cells on a device, so that what a call costs is little of it
    cells = timing.spread(batches.stack(seeds_of(config, each * jax.device_count())))
    prepared = timing.compiled(prepare, cells)[0](cells)
    taken = {}
    for name, part in parts(config).items():
        program, _ = timing.compiled(part, *prepared, cells)
        taken[name] = timing.seconds(program, *prepared, cells, repeats=repeats) / each
    return taken


def measure(quick: bool) -> dict[str, dict[str, float]]:
    """Of PEPS at width 64, and of SAC at each width."""
    steps, repeats = (800, 1) if quick else (8_000, 7)
    rounds = [("peps", 64), *(("sac", width) for width in WIDTHS)]
    config = lambda method, width: Config(env="nav-d1", method=method, hidden_sizes=(width, width))
    return {
        f"{method} {width}": seconds_of_parts(shortened(config(method, width), steps), repeats)
        for method, width in rounds
    }
