"""Policy shaping (Griffith et al. 2013): one policy on the environment's reward, one on human feedback, and their product acts.

    pi(a|s) ~ pi_A(a|s) pi_H(a|s),

normalised over discrete actions; for continuous ones it is the product of the Gaussians before tanh, whose mean is weighed by
their precisions. Feedback is PEPS's r-hat, from the same teacher and budget: the two differ in what they make of it.

Two policies that are sure of opposite actions make one that is sure of neither: (0.1, 0.9) and (0.9, 0.1) give (0.5, 0.5).
"""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array

from peps_jax.learning import sac, team
from peps_jax.methods import preference_based
from peps_jax.methods.method import register
from peps_jax.methods.preference_based import PREFERENCE_BASED
from peps_jax.settings import AgentSettings


def behave(agents: tuple[sac.Agent, ...], observation: Array, key: Array, settings: AgentSettings) -> Array:
    """What acts while they learn: a product of candidates, which the critics value, in every environment.

    A product of Gaussians acts in a third of them, and each policy alone in another third: those policies are valued by what
    each would do alone, and SAC goes astray with a policy whose actions it never sees carried out.
    """
    if settings.product == "candidates":
        return team.act(agents, observation, key, settings)[0]
    teams = [agents, *((agent,) for agent in agents)]
    keys = sac.agent_keys(key, len(teams))
    actions = [team.act(some, observation, key, settings)[0] for some, key in zip(teams, keys, strict=True)]
    env = jnp.arange(observation.shape[0])
    return jnp.stack(actions, 1)[env, env % len(teams)]


POLICY_SHAPING = register(
    PREFERENCE_BASED._replace(
        name="policy_shaping",
        rewards=(lambda knowledge, transitions, settings: transitions.reward, preference_based.reward),
        settings=preference_based.from_nothing,
        behave=behave,
    )
)
