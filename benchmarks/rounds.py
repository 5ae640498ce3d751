"""Where a round's time goes: each part of it as a program of its own, on what half a training leaves."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from typing import Any, NamedTuple

import equal_work
import jax
import jax.numpy as jnp
import timing
from training import WIDTHS, seeds_of, shortened

from peps_jax import Config, rollout
from peps_jax.execution.program import stack
from peps_jax.learning import dynamics, replay, team
from peps_jax.methods import peps, preference_based
from peps_jax.preferences import data
from peps_jax.preferences.data import PreferenceSet
from peps_jax.round import round_at
from peps_jax.train import TrainingState
from peps_jax.trajectory import Trajectory

train = importlib.import_module("peps_jax.train")  # the module: the package shows the function of that name

PARTS = {  # as the text calls them
    "collect": "collecting",
    "ask": "choosing and answering queries",
    "fit_dynamics": "fitting T_A",
    "fit_surrogate": "fitting r̂",
    "value": "r̂ and entropies",
    "improve": "SAC's updates",
}
BY_MINIBATCH = (
    "value by minibatch"  # tried: r-hat and entropies of what is drawn from replay instead of all that is there
)


class Prepared(NamedTuple):
    """A training half way, and what the parts of its next round hand to one another."""

    state: TrainingState
    trajectory: Trajectory
    preferences: PreferenceSet | None  # that are known


def prepare(config: Config) -> Prepared:
    """Half a training."""
    training, index, key = train.prepare(config), config.num_rounds // 2, jax.random.key(1)
    state, _ = train.run_rounds(train.init(training), jnp.arange(index, dtype=jnp.int32), training)
    settings = training.settings
    act = lambda observation, key, time: team.act(state.agents, observation, key, settings.agent)[0]
    _, trajectory, _ = rollout.collect(state.actors, act, key, training.problem, settings.rollout)
    preferences = None if state.preferences is None else data.known(state.preferences, index)
    return Prepared(state, trajectory, preferences)


def parts(structure: Config) -> dict[str, Callable[[Prepared, Config], Any]]:
    """What a round of PEPS does, by the names of `PARTS`; of SAC, what it does of that; `BY_MINIBATCH`; and the `whole`."""
    index, key = jnp.int32(structure.num_rounds // 2), jax.random.key(1)
    plain = lambda config: train.prepare(config.replace(method="sac"))  # asks nothing, and takes rewards as they are
    now = lambda given, training: round_at(index, given.state.key, training.settings.schedule)

    def collect(given: Prepared, config: Config) -> Any:
        training = plain(config)
        return train.collect_and_ask(given.state, now(given, training), training)

    def ask(given: Prepared, config: Config) -> Any:
        training = train.prepare(config)
        segments = training.method.ask(given.state.knowledge, given.trajectory, now(given, training), training.settings)
        unasked, room = training.settings.queries.unasked_rounds, training.settings.queries.room
        _, queries = data.ask(given.state.preferences, segments, index, unasked, room, given.state.budget)
        return training.answer(key, queries, training.problem, training.settings.human)

    def fit_dynamics(given: Prepared, config: Config) -> Any:
        training, state = train.prepare(config), given.state
        filled = now(given, training).filled
        return dynamics.fit(state.knowledge.dynamics, state.replay, filled, key, training.settings.dynamics)

    def fit_surrogate(given: Prepared, config: Config) -> Any:
        training, state = train.prepare(config), given.state
        filled = now(given, training).filled
        return preference_based.fit_surrogate(
            state.knowledge.surrogate, state.replay, given.preferences, filled, key, training.settings
        )

    def value_by(way: Callable[..., Any]) -> Callable[[Prepared, Config], Any]:
        def value(given: Prepared, config: Config) -> Any:
            training, state = train.prepare(config), given.state
            agent, at = training.settings.agent, now(given, training)
            drawn = replay.draw(key, (agent.updates, agent.batch_size), at.filled)
            reward = lambda rows: peps.reward(state.knowledge, rows, training.settings)
            return way(reward, state.replay, drawn, at, training.settings)

        return value

    def update(given: Prepared, config: Config) -> Any:
        training = plain(config)
        return train.improve(given.state, now(given, training), training)

    def whole(given: Prepared, config: Config) -> Any:
        return train.run_round(given.state, index, train.prepare(config))

    learned = {
        "ask": ask,
        "fit_dynamics": fit_dynamics,
        "fit_surrogate": fit_surrogate,
        "value": value_by(train.values),
        BY_MINIBATCH: value_by(lambda reward, buffer, drawn, *_: train.values_of_minibatches(reward, buffer, drawn)),
    }
    return {"collect": collect} | (learned if structure.method == "peps" else {}) | {"improve": update, "whole": whole}


def seconds_of_parts(config: Config, repeats: int) -> dict[str, float]:
    """Seconds of each part of one run's round, while all devices do the same."""
    each = 4  # runs on a device, so that what a call costs is little of it
    runs = timing.spread(stack(seeds_of(config, each * jax.device_count())))
    prepared = timing.compiled(prepare, runs)[0](runs)
    taken = {}
    for name, part in parts(config).items():
        program, _ = timing.compiled(part, prepared, runs)
        taken[name] = timing.seconds(program, prepared, runs, repeats=repeats) / each
    return taken


def measure(quick: bool) -> dict[str, dict[str, float]]:
    """Of PEPS at width 64, and of SAC at each width."""
    steps, repeats = (800, 1) if quick else (8_000, 7)
    rounds = [("peps", 64), *(("sac", width) for width in WIDTHS)]
    return {
        f"{method} {width}": seconds_of_parts(shortened(equal_work.measured(method, width), steps), repeats)
        for method, width in rounds
    }
