"""Several agents that act together: each learns from a reward of its own, and their policies' product acts.

    pi(a|s) ~ prod_j pi_j(a|s)                                                      (Griffith et al. 2013)

Two ways to make it. "gaussians" is the normalised product of the policies as they are: exact for discrete actions; of two
Gaussians it is one Gaussian, which lies between them and can hold two routes no more than they can. "candidates" goes back to
what a soft policy stands for, pi_j ~ exp(Q_j / alpha): the product is exp(sum_j Q_j / alpha), which is drawn from among actions
that the policies and chance propose, by importance weights; and each agent's critics value what the product does, not what the
agent would do alone. One agent acts by its own policy, whichever way.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import chex
import jax
import jax.numpy as jnp
from jax import Array

from peps_jax import generator
from peps_jax.learning import sac
from peps_jax.learning.sac import Agent, Noise
from peps_jax.settings import AgentSettings
from peps_jax.trajectory import Transition

# candidates of each policy, and of the uniform one: to learn, the better of what they do; a few more where they act
TO_LEARN, TO_ACT = 1, 4


class Candidates(NamedTuple):
    """Actions to choose from, and the product's view of them; the leading axis is the candidates'."""

    action: Array  # (candidates, ..., action_size), or (candidates, ...) of discrete ones
    values: Array  # (agents, candidates, ...) min Q of each agent
    log_probability: Array  # (candidates, ...) of each to be drawn
    log_ratio: Array  # (candidates, ...) l_pi of the product: its log-density relative to the uniform policy


def policies_of(agents: tuple[Agent, ...], observation: Array, settings: AgentSettings) -> Any:
    """The agents' policies, stacked along a leading axis."""
    head, policy_network, _ = sac.networks(settings)
    policies = [head.policy(policy_network.apply(agent.policy, observation)) for agent in agents]
    return jax.tree.map(lambda *each: jnp.stack(each), *policies)


def acting_policy(agents: tuple[Agent, ...], observation: Array, settings: AgentSettings) -> Any:
    """The only agent's own policy, or the normalised product of several agents' policies."""
    policies = policies_of(agents, observation, settings)
    return jax.tree.map(lambda each: each[0], policies) if len(agents) == 1 else sac.head_of(settings).product(policies)


def candidates(
    agents: tuple[Agent, ...],
    critics: tuple[Any, ...],
    observation: Array,
    key: Array,
    number: int,
    settings: AgentSettings,
) -> Candidates:
    """What the product exp(sum_j Q_j / alpha) makes of actions that are proposed at `observation` (..., observation_size).

    `number` candidates x each are drawn from every policy and from the uniform one, so their density q relative to the uniform
    policy is the mean of theirs. One is drawn with probability proportional to exp(sum_j Q_j / alpha) / q, and the same weights'
    mean estimates the product's normalisation. `settings.temperature` is alpha, in reward units.
    """
    head, _, network = sac.networks(settings)
    policies = policies_of(agents, observation, settings)
    action, log_proposal = head.propose(policies, key, observation.shape[:-1], number)
    value = lambda params: jnp.min(jax.vmap(lambda one: head.critics(network, params, observation, one))(action), 1)
    values = jnp.stack([value(params) for params in critics])  # (agents, candidates, ...)
    chex.assert_equal_shape([values[0], log_proposal])
    alpha = jnp.maximum(settings.temperature * settings.reward_scale, 1e-6)
    log_worth = jnp.sum(values, 0) / alpha
    log_weight = log_worth - log_proposal
    total = jax.scipy.special.logsumexp(log_weight, 0)
    return Candidates(
        action, values, log_weight - total[None], log_worth - (total - jnp.log(float(log_weight.shape[0])))[None]
    )


def _pick(offered: Candidates, index: Array) -> tuple[Array, Array]:
    at = lambda rows: jnp.take_along_axis(rows, index.reshape(1, *index.shape, *(1,) * (rows.ndim - 1 - index.ndim)), 0)
    return at(offered.action)[0], at(offered.log_ratio)[0]


def _by_candidates(agents: tuple[Agent, ...], settings: AgentSettings) -> bool:
    return len(agents) > 1 and settings.product == "candidates"


def act(agents: tuple[Agent, ...], observation: Array, key: Array, settings: AgentSettings) -> tuple[Array, Array]:
    """An action drawn from what acts, and l_pi(a|s)."""
    if _by_candidates(agents, settings):
        key_propose, key_choose = jax.random.split(key)
        offered = candidates(agents, _critics(agents), observation, key_propose, TO_ACT, settings)
        return _pick(offered, jax.random.categorical(key_choose, offered.log_probability, 0))
    head = sac.head_of(settings)
    return head.sample(acting_policy(agents, observation, settings), head.noise(key, observation.shape[:-1]))


def mode(agents: tuple[Agent, ...], observation: Array, settings: AgentSettings) -> tuple[Array, Array]:
    """What acts at its most likely, before squashing or of always the same candidates, and l_pi(a|s)."""
    if _by_candidates(agents, settings):
        offered = candidates(agents, _critics(agents), observation, generator.key(0), TO_ACT, settings)
        return _pick(offered, jnp.argmax(offered.log_ratio, 0))
    return sac.head_of(settings).mode(acting_policy(agents, observation, settings))


def _critics(agents: tuple[Agent, ...]) -> tuple[Any, ...]:
    return tuple(agent.critics for agent in agents)


class Step(NamedTuple):
    """What one update of all agents is made of; in a scan, many of them along a leading axis."""

    batch: Transition  # the same for all
    rewards: tuple[Array, ...]  # of each agent, in scaled units
    noises: tuple[Noise, ...]
    key: Array  # of the candidates


def update(
    agents: tuple[Agent, ...], step: Step, temperature: Array, settings: AgentSettings
) -> tuple[tuple[Agent, ...], dict[str, Array]]:
    """One SAC update of every agent on the same minibatch; figures are the agents' means. `temperature` is in scaled units."""
    values = _next_values(agents, step, temperature, settings)
    made = [
        sac.update(agent, step.batch._replace(reward=reward), temperature, noise, settings, value)
        for agent, reward, noise, value in zip(agents, step.rewards, step.noises, values, strict=True)
    ]
    after, infos = zip(*made, strict=True)
    return after, jax.tree.map(lambda *values: jnp.mean(jnp.stack(values)), *infos)


def _next_values(
    agents: tuple[Agent, ...], step: Step, temperature: Array, settings: AgentSettings
) -> tuple[Array | None, ...]:
    """V_j(s') under what acts, for each agent by its target critics; None where each values its own policy.

    The policy entropy is the team's, and divided among them: so the values add up to those of the rewards' sum.
    """
    if not _by_candidates(agents, settings):
        return (None,) * len(agents)
    current = settings.replace(temperature=temperature / settings.reward_scale)
    targets = tuple(agent.targets for agent in agents)
    offered = candidates(agents, targets, step.batch.next_observation, step.key, TO_LEARN, current)
    probability = jnp.exp(offered.log_probability)
    entropy = -jnp.sum(probability * offered.log_ratio, 0)
    values = jnp.sum(probability[None] * offered.values, 1)
    return tuple(value + temperature * entropy / len(agents) for value in values)
