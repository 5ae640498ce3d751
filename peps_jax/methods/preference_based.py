"""What methods that ask a teacher have in common: how they ask, and how they learn r-hat from the answers."""

from __future__ import annotations

import jax
from flax import struct
from jax import Array

from peps_jax.learning import replay, surrogate
from peps_jax.learning.surrogate import SurrogateState
from peps_jax.methods.method import Method
from peps_jax.preferences import queries
from peps_jax.preferences.data import PreferenceSet, Segments
from peps_jax.round import Round
from peps_jax.settings import Settings
from peps_jax.trajectory import Trajectory, Transition

LEVELLED_ON = 1024  # transitions of replay on which r-hat's level is set


@struct.dataclass
class Knowledge:
    """What a method knows that learns r-hat and nothing else beside its policies."""

    surrogate: SurrogateState  # r_hat


def init(key: Array, settings: Settings) -> Knowledge:
    """An untrained r-hat."""
    return Knowledge(surrogate=surrogate.init(key, settings.surrogate))


def ask(knowledge: Knowledge, trajectory: Trajectory, now: Round, settings: Settings) -> Segments:
    """The queries of this round: of the latest trajectories' pairs, those from which the ensemble learns most."""
    key_candidates, key_choose, _ = now.keys.ask
    pairs = queries.candidates(trajectory, key_candidates, settings.queries)
    logits = surrogate.preference_logits(knowledge.surrogate, pairs, settings.surrogate)
    chosen = queries.choose(logits, queries.describe(pairs), key_choose, settings.queries)
    return jax.tree.map(lambda rows: rows[chosen], pairs)


def fit_surrogate(
    state: SurrogateState, buffer: Transition, preferences: PreferenceSet, filled: Array, key: Array, settings: Settings
) -> tuple[SurrogateState, dict[str, Array]]:
    """r-hat from the preferences that are known, and its level over what was visited."""
    key_fit, key_level = jax.random.split(key)
    state, info = surrogate.fit(state, preferences, key_fit, settings.surrogate)
    visited = replay.sample(buffer, key_level, (LEVELLED_ON,), filled)
    return surrogate.pin(state, visited.observation, visited.action, visited.reward, settings.surrogate), info


def learn(
    knowledge: Knowledge, buffer: Transition, preferences: PreferenceSet, now: Round, settings: Settings
) -> tuple[Knowledge, dict[str, Array]]:
    """Learns r-hat alone."""
    _, key, _ = now.keys.learn
    state, info = fit_surrogate(knowledge.surrogate, buffer, preferences, now.filled, key, settings)
    return Knowledge(surrogate=state), info


def reward(knowledge: Knowledge, transitions: Transition, settings: Settings) -> Array:
    """r_hat(s, a)."""
    return surrogate.predict(
        knowledge.surrogate, transitions.observation, transitions.action, transitions.reward, settings.surrogate
    )


def from_nothing(settings: Settings) -> Settings:
    """r-hat without a prior: of a method in which the reward that the agent observes has no part."""
    return settings.replace(surrogate=settings.surrogate.replace(prior="none"))


# SAC on r-hat alone
PREFERENCE_BASED = Method(
    name="preference_based",
    rewards=(reward,),
    asks=True,
    init=init,
    ask=ask,
    learn=learn,
    surrogate=lambda knowledge: knowledge.surrogate,
)
