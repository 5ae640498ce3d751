"""DARC (Eysenbach et al. 2021) for who may step the human's belief as a simulator: SAC on r_A + lambda (r_H + Delta r).

Delta r = l_H - l_A is learned by a classifier that tells what the belief makes of the visited states and actions from what
happened: the agent is to live in the true domain as if it were the believed one. DARC's second classifier, of states and
actions alone, isn't needed where both are stepped from the same ones. A yardstick, as the oracle: it asks nobody, because it has
the belief itself.
"""

from __future__ import annotations

import chex
from flax import struct
from jax import Array

from peps_jax.learning import classifier
from peps_jax.methods import peps
from peps_jax.methods.method import Method, register
from peps_jax.preferences.data import PreferenceSet
from peps_jax.round import Round
from peps_jax.settings import Settings
from peps_jax.trajectory import Transition

MORE_UPDATES = 5  # of the classifier than T_A would have


@struct.dataclass
class Knowledge:
    """What DARC learns beside the policy."""

    classifier: classifier.ClassifierState


def init(key: Array, settings: Settings) -> Knowledge:
    """An untrained classifier."""
    return Knowledge(classifier=classifier.init(key, settings.dynamics))


def learn(
    knowledge: Knowledge, buffer: Transition, preferences: PreferenceSet | None, now: Round, settings: Settings
) -> tuple[Knowledge, dict[str, Array]]:
    """The classifier from replay."""
    state, info = classifier.fit(knowledge.classifier, buffer, now.filled, now.keys.learn[:2], settings.dynamics)
    return Knowledge(classifier=state), info


def reward(knowledge: Knowledge, transitions: Transition, settings: Settings) -> Array:
    """r_A + lambda (r_H + Delta r)."""
    log_ratio = classifier.log_ratio(knowledge.classifier, transitions, settings.dynamics)
    chex.assert_equal_shape([transitions.reward, transitions.human_reward, log_ratio])
    return transitions.reward + settings.objective.lam * (transitions.human_reward + log_ratio)


def well_taught(settings: Settings) -> Settings:
    """With what the human imagines of every step, and a classifier that is the critics' equal.

    Of T_A's own size and pace it learns too slowly, and the policy stays well behind the oracle's.
    """
    size_and_pace = settings.dynamics.replace(
        updates=MORE_UPDATES * settings.dynamics.updates,
        hidden_sizes=settings.agent.hidden_sizes,
        learning_rate=settings.agent.learning_rate,
    )
    return settings.replace(rollout=settings.rollout.watching_all().replace(imagines=True), dynamics=size_and_pace)


DARC = register(
    Method(
        name="darc",
        rewards=(reward,),
        uses_lam=True,
        settings=well_taught,
        init=init,
        learn=learn,
        entropy_weight=peps.entropy_weight,
    )
)
