"""Agents that act together, by candidates: exact for discrete actions, and by numeric integration for continuous ones."""

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import Probe, ProbeParams, settings

from peps_envs import Discrete
from peps_jax.learning import sac, team
from peps_jax.trajectory import Transition

ALPHA = 0.5  # in reward units


@pytest.fixture
def own(line):
    return settings(line.replace(product="candidates", temperature=ALPHA)).agent


def agents_of(own, number=2):
    return tuple(sac.init(jax.random.key(seed), own) for seed in range(number))


def worth(agents, observation, actions, own):
    """sum_j min Q_j / alpha of each action at one observation."""
    head, _, network = sac.networks(own)
    value = lambda params: jnp.min(head.critics(network, params, observation, actions), 0)
    return np.asarray(sum(value(agent.critics) for agent in agents) / (ALPHA * own.reward_scale), np.float64)


def test_discrete_actions_are_drawn_by_the_softmax_of_the_summed_values(line):
    line = line.replace(env=Probe(action_space=Discrete(3)), params=ProbeParams(), belief=ProbeParams())
    own = settings(line.replace(product="candidates", temperature=ALPHA)).agent
    agents, observation = agents_of(own), jnp.array([0.4])
    values = worth(agents, jnp.broadcast_to(observation, (3, 1)), jnp.arange(3), own)
    expected = values - np.log(np.exp(values).sum())
    offered = team.candidates(agents, [agent.critics for agent in agents], observation, jax.random.key(0), 1, own)
    np.testing.assert_array_equal(offered.action, np.arange(3))
    np.testing.assert_allclose(offered.log_probability, expected, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(offered.log_ratio, expected + np.log(3), rtol=1e-4, atol=1e-5)
    action, ratio = team.mode(agents, observation, own)
    assert int(action) == values.argmax()
    np.testing.assert_allclose(ratio, expected.max() + np.log(3), rtol=1e-4, atol=1e-5)


def test_continuous_actions_are_drawn_as_if_the_product_were_integrated(own, monkeypatch):
    """Where policies propose elsewhere than the product has its mass, the importance weights make up for it."""
    agents = []
    for agent, scale in zip(agents_of(own), (3.0, 9.0), strict=True):
        policy = jax.tree.map(jnp.zeros_like, agent.policy)
        policy["params"]["Dense_1"]["bias"] = jnp.array([0.7, 0.0])
        critics = jax.tree.map(lambda leaf, scale=scale: leaf * scale, agent.critics)
        agents.append(agent.replace(policy=policy, critics=critics))
    monkeypatch.setattr(team, "TO_ACT", 100)  # the weights are exact as their number grows
    agents, number = tuple(agents), 2_000
    observations = jnp.full((number, 1), 0.3)
    grid = jnp.linspace(-1, 1, number)[:, None]
    density = np.exp(worth(agents, observations, grid, own))
    density /= density.sum()
    action, ratio = jax.jit(team.act)(agents, observations, jax.random.key(0), own)
    mean = float(density @ np.asarray(grid)[:, 0])
    assert abs(mean) > 0.1, "the product leans to a side, or this says nothing"
    np.testing.assert_allclose(jnp.mean(action), mean, atol=0.04)
    # E log(p / uniform) under p
    np.testing.assert_allclose(jnp.mean(ratio), density @ np.log(density * number), atol=0.05)


def test_values_of_the_team_add_up_to_those_of_one_reward(own):
    """V_j(s') are under one acting policy, so their sum is that of an agent whose value is the sum."""
    agents = agents_of(own)
    step = _step(own)
    first, second = team._next_values(agents, step, jnp.asarray(ALPHA * own.reward_scale), own)
    targets = [agent.targets for agent in agents]
    offered = team.candidates(agents, targets, step.batch.next_observation, step.key, team.TO_LEARN, own)
    probability = np.exp(np.asarray(offered.log_probability, np.float64))
    np.testing.assert_allclose(probability.sum(0), 1.0, rtol=1e-5)
    soft = np.sum(probability * (np.asarray(offered.values).sum(0) - ALPHA * own.reward_scale * offered.log_ratio), 0)
    np.testing.assert_allclose(first + second, soft, rtol=1e-4, atol=1e-6)


def test_one_agent_and_gaussians_value_their_own_policies(own):
    agents, step = agents_of(own), _step(own)
    assert team._next_values(agents[:1], step, jnp.ones(()), own) == (None,)
    assert team._next_values(agents, step, jnp.ones(()), own.replace(product="gaussians")) == (None, None)


def test_an_update_moves_every_agent_by_its_own_reward(own):
    agents, step = agents_of(own), _step(own)
    after, info = jax.jit(team.update)(agents, step, jnp.asarray(0.05), own)
    other = step._replace(rewards=(step.rewards[0], step.rewards[1] + 1.0))
    changed, _ = jax.jit(team.update)(agents, other, jnp.asarray(0.05), own)
    chex.assert_trees_all_equal(after[0], changed[0])
    first, second = (np.ravel(jax.tree.leaves(every[1].critics)[0]) for every in (after, changed))
    assert not np.array_equal(first, second)
    chex.assert_tree_all_finite(info)


def _step(own):
    rows = jnp.linspace(-1.0, 1.0, 5)
    batch = Transition(
        observation=rows[:, None], action=rows[:, None], reward=rows, next_observation=rows[:, None] * 0.9,
        movement=rows[:, None], terminated=rows > 0.9, human_reward=rows, log_belief=rows,
    )  # fmt: skip
    noises = tuple(sac.draw_noise(jax.random.key(seed), (5,), own) for seed in (1, 2))
    return team.Step(batch, (rows, -rows), noises, jax.random.key(3))
