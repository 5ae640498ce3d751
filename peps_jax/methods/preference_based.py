"""What methods that ask a human have in common: how they ask, and how they learn r-hat from the answers."""

from __future__ import annotations

from collections.abc import Callable

import jax
from flax import struct
from jax import Array

from peps_jax.config import Config
from peps_jax.learning import surrogate
from peps_jax.learning.surrogate import PLAIN, Recipe, SurrogateState
from peps_jax.methods.method import Method, true_world
from peps_jax.preferences import queries
from peps_jax.trajectory import Preferences, Segments, Trajectory, Transition


@struct.dataclass
class Knowledge:
    """What a method knows that learns r-hat and nothing else beside its policies."""

    surrogate: SurrogateState  # r_hat


def ask(state: SurrogateState, trajectory: Trajectory, key: Array, config: Config, recipe: Recipe = PLAIN) -> Segments:
    """The queries of this round: of the latest trajectories' pairs, those from which the ensemble learns most."""
    key_candidates, key_choose = jax.random.split(key)
    pairs = queries.candidates(trajectory, key_candidates, config)
    logits = surrogate.preference_logits(state, pairs, config, recipe)
    chosen = queries.choose(logits, queries.describe(pairs), key_choose, config)
    return jax.tree.map(lambda rows: rows[chosen], pairs)


def learn(
    state: SurrogateState,
    buffer: Transition,
    filled: Array,
    preferences: Preferences,
    index: Array,
    keys: tuple[Array, Array],
    config: Config,
    recipe: Recipe = PLAIN,
) -> tuple[SurrogateState, dict[str, Array]]:
    """r-hat from the preferences given so far, of which round `index` brings the last; `keys` to resample and to fit."""
    key_add, key_fit = keys
    position = index * config.queries_per_round
    taught = surrogate.add(state, preferences, position, key_add, config)
    return surrogate.fit(taught, buffer, position + config.queries_per_round, filled, key_fit, config, recipe)


def reward(knowledge: Knowledge, transitions: Transition, config: Config) -> Array:
    """r_hat(s, a)."""
    return surrogate.predict(knowledge.surrogate, transitions.observation, transitions.action, config)


def method(
    name: str, rewards: tuple[Callable[[Knowledge, Transition, Config], Array], ...], recipe: Recipe = PLAIN
) -> Method:
    """The method `name`, which learns r-hat by `recipe`, and a policy for each of `rewards` at SAC's own temperature."""

    def learn_surrogate(knowledge, buffer, filled, preferences, index, key, config):
        keys = tuple(jax.random.split(key))
        state, info = learn(knowledge.surrogate, buffer, filled, preferences, index, keys, config, recipe)
        return Knowledge(surrogate=state), info

    return Method(
        name=name,
        uses_lam=False,
        world=true_world,
        init=lambda key, config: Knowledge(surrogate=surrogate.init(key, config)),
        ask=lambda knowledge, trajectory, key, config: ask(knowledge.surrogate, trajectory, key, config, recipe),
        learn=learn_surrogate,
        rewards=rewards,
        entropy_weight=lambda config: 0.0,
    )
