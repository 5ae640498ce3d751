"""Soft actor-critic: its densities, its losses on hand-made transitions, and values that are known in closed form."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import Probe, ProbeParams, settings

from peps_envs import Box, Discrete
from peps_jax import rollout
from peps_jax.learning import policy_heads, sac
from peps_jax.learning.policy_heads import Gaussian
from peps_jax.trajectory import Transition


def test_tanh_jacobian_against_a_numeric_derivative():
    outputs = jnp.array([0.3, -0.2, 0.1, -0.4])
    density = policy_heads.squashed(policy_heads.gaussian(outputs))
    mean, raw = np.split(np.asarray(outputs, np.float64), 2)
    sd = np.exp(
        policy_heads.MIN_LOG_SD + 0.5 * (policy_heads.MAX_LOG_SD - policy_heads.MIN_LOG_SD) * (np.tanh(raw) + 1)
    )
    for action in ([0.1, -0.3], [0.5, -0.6], [-0.2, 0.3]):
        before, step = np.arctanh(action), 1e-6
        slope = (np.tanh(before + step) - np.tanh(before - step)) / (2 * step)
        gaussian = -0.5 * ((before - mean) / sd) ** 2 - np.log(sd) - 0.5 * np.log(2 * np.pi)
        np.testing.assert_allclose(density.log_prob(jnp.array(action)), np.sum(gaussian - np.log(slope)), rtol=1e-4)


def test_continuous_log_ratio_is_relative_to_the_uniform_policy():
    head = policy_heads.continuous_head(1, 1)
    policy = policy_heads.gaussian(jnp.array([0.4, 0.2]))
    actions = jnp.linspace(-0.9999, 0.9999, 20_001)[:, None]
    ratio = jax.jit(jax.vmap(head.log_ratio, in_axes=(None, 0)))(policy, actions)
    # pi = exp(ratio) / 2 integrates to 1, and its divergence from the uniform policy is not negative
    density = np.exp(np.asarray(ratio, np.float64)) / 2
    np.testing.assert_allclose(np.trapezoid(density, actions[:, 0]), 1.0, atol=5e-3)
    assert np.trapezoid(density * np.asarray(ratio), actions[:, 0]) > 0
    action, sampled = head.sample(policy, head.noise(jax.random.key(0), ()))
    np.testing.assert_allclose(sampled, head.log_ratio(policy, action), rtol=1e-3)


@pytest.mark.parametrize("mean", [0.0, 3.5, 6.0, 8.0, 20.0, -20.0])
@pytest.mark.parametrize("sd", [0.0069, 0.3, 7.0])
def test_densities_of_own_actions_are_exact_however_saturated(mean, sd):
    """log N(x) - log(1 - tanh(x)^2) + log 2 in double precision, of the mode and of a sample; (8, 0.0069) gives 19.37."""
    head = policy_heads.continuous_head(1, 1)
    policy = Gaussian(jnp.array([mean], jnp.float32), jnp.log(jnp.array([sd], jnp.float32)))
    for noise in (0.0, 1.3):
        before = mean + sd * noise
        log_slope = 2 * (math.log(2) - abs(before) - math.log1p(math.exp(-2 * abs(before))))
        expected = -0.5 * noise**2 - math.log(sd) - 0.5 * math.log(2 * math.pi) - log_slope + math.log(2)
        action, ratio = head.sample(policy, jnp.array([noise]))
        np.testing.assert_allclose(ratio, expected, rtol=1e-5, atol=1e-4)
        np.testing.assert_allclose(action, np.tanh(before), rtol=1e-5, atol=1e-6)
        if noise == 0.0:
            np.testing.assert_allclose(head.mode(policy)[1], expected, rtol=1e-5, atol=1e-4)


def test_samples_follow_the_policy():
    key, shape = jax.random.key(0), (40_000,)
    head = policy_heads.continuous_head(1, 1)
    policy = policy_heads.gaussian(jnp.array([0.4, 0.2]))
    action, ratio = head.sample(
        jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (*shape, 1)), policy), head.noise(key, shape)
    )
    places = np.linspace(-0.9999, 0.9999, 20_001)
    log_ratio = np.asarray(jax.jit(jax.vmap(head.log_ratio, in_axes=(None, 0)))(policy, jnp.asarray(places)[:, None]))
    density = np.exp(log_ratio) / 2
    np.testing.assert_allclose(action.mean(), np.trapezoid(density * places, places), atol=0.02)
    np.testing.assert_allclose(ratio.mean(), np.trapezoid(density * log_ratio, places), atol=0.02)
    head = policy_heads.discrete_head(1, 3)
    outputs = jnp.array([0.2, -1.0, 0.7])
    action, _ = head.sample(jnp.broadcast_to(outputs, (*shape, 3)), head.noise(key, shape))
    np.testing.assert_allclose(np.bincount(action) / shape, jax.nn.softmax(outputs), atol=0.01)


def test_discrete_log_ratio_is_0_for_the_uniform_policy():
    head = policy_heads.discrete_head(1, 5)
    for action in range(5):
        np.testing.assert_allclose(head.log_ratio(jnp.full(5, 0.7), jnp.asarray(action)), 0.0, atol=1e-6)
    certain = jnp.array([50.0, 0, 0, 0, 0])
    np.testing.assert_allclose(head.log_ratio(certain, jnp.asarray(0)), math.log(5), rtol=1e-5)
    assert int(head.mode(certain)[0]) == 0


@pytest.mark.parametrize("space", [Box(2), Discrete(3)])
def test_random_actions_lie_in_the_action_space(space):
    draw = jax.vmap(lambda key: rollout.random_action(space, key))
    actions = np.asarray(draw(jax.random.split(jax.random.key(0), 300)))
    if isinstance(space, Box):
        assert actions.min() >= -1
        assert actions.max() <= 1
        np.testing.assert_allclose(actions.mean(0), 0.0, atol=0.15)
    else:
        assert set(actions.tolist()) == {0, 1, 2}


def discrete(line, size=3):
    return line.replace(env=Probe(action_space=Discrete(size)), params=ProbeParams(), belief=ProbeParams())


def test_discrete_expectations_are_exact(line):
    config = settings(discrete(line)).agent
    head, _, critic_network = sac.networks(config)
    agent = sac.init(jax.random.key(0), config)
    observation, outputs = jnp.array([0.3]), jnp.array([0.2, -1.0, 0.7])
    value, ratio = head.expect(outputs, head.noise(jax.random.key(1), ()), critic_network, agent.critics, observation)
    probabilities = np.exp(outputs) / np.exp(outputs).sum()
    by_action = [head.critics(critic_network, agent.critics, observation, jnp.asarray(action)) for action in range(3)]
    # the same minimum for an action at a time, weighed by hand
    np.testing.assert_allclose(value, np.dot(probabilities, np.min(by_action, 1)), rtol=1e-5)
    np.testing.assert_allclose(ratio, np.dot(probabilities, np.log(probabilities)) + np.log(3), rtol=1e-5)


def two_transitions():
    """The same step twice: once the MDP ended with it, once only its time was up."""
    return Transition(
        observation=jnp.zeros((2, 1)), action=jnp.full((2, 1), 0.5), reward=jnp.array([3.0, 3.0]),
        next_observation=jnp.full((2, 1), 0.2), movement=jnp.full((2, 1), 2.0), terminated=jnp.array([True, False]),
        human_reward=jnp.zeros(2),
        log_belief=jnp.zeros(2),
    )  # fmt: skip


def test_critic_targets_by_hand(line):
    config = settings(line.replace(gamma=0.9)).agent
    agent = sac.init(jax.random.key(0), config)
    # targets that always say 7 and 5: the smaller counts
    targets = jax.tree.map(jnp.zeros_like, agent.targets)
    targets["params"]["Dense_1"]["bias"] = jnp.array([[7.0], [5.0]])
    agent, batch, temperature = agent.replace(targets=targets), two_transitions(), 0.3
    head, policy_network, _ = sac.networks(config)
    noise = head.noise(jax.random.key(1), (2,))
    _, ratio = head.sample(head.policy(policy_network.apply(agent.policy, batch.next_observation)), noise)
    found = sac.critic_targets(batch, sac.next_value(agent, batch, temperature, noise, config), config)
    np.testing.assert_allclose(found, [3.0, 3.0 + 0.9 * (5.0 - temperature * ratio[1])], rtol=1e-5)


def test_critic_loss_by_hand(line):
    config = settings(line).agent
    agent = sac.init(jax.random.key(0), config)
    critics = jax.tree.map(jnp.zeros_like, agent.critics)
    critics["params"]["Dense_1"]["bias"] = jnp.array([[1.0], [2.0]])
    loss = sac.critic_loss(critics, jnp.array([0.0, 4.0]), two_transitions(), config)
    np.testing.assert_allclose(loss, 0.5 * ((1 + 9) / 2 + (4 + 4) / 2), rtol=1e-6)


def test_policy_loss_by_hand(line):
    config = settings(discrete(line)).agent
    agent = sac.init(jax.random.key(0), config)
    critics = jax.tree.map(jnp.zeros_like, agent.critics)
    critics["params"]["Dense_1"]["bias"] = jnp.array([[1.0, 2.0, 3.0], [3.0, 2.0, 1.0]])
    uniform = jax.tree.map(jnp.zeros_like, agent.policy)
    batch = two_transitions()._replace(action=jnp.zeros(2, jnp.int32))
    noise = sac.draw_noise(jax.random.key(1), (2,), config).policy
    loss, entropy = sac.policy_loss(uniform, critics, batch, 0.3, noise, config)
    np.testing.assert_allclose(entropy, 0.0, atol=1e-6)
    np.testing.assert_allclose(loss, -(1 + 2 + 1) / 3, rtol=1e-6)


def test_targets_follow_slowly(line):
    config = settings(line.replace(target_rate=0.1)).agent
    agent = sac.init(jax.random.key(0), config)
    after, _ = jax.jit(sac.update)(
        agent, two_transitions(), 0.3, sac.draw_noise(jax.random.key(1), (2,), config), config
    )
    expected = jax.tree.map(lambda old, new: 0.9 * old + 0.1 * new, agent.targets, after.critics)
    jax.tree.map(lambda one, two: np.testing.assert_allclose(one, two, rtol=1e-4, atol=1e-6), after.targets, expected)
    np.testing.assert_array_equal(after.log_temperature, agent.log_temperature)


@pytest.mark.parametrize("excess", [-0.5, 0.5])
def test_temperature_rises_where_the_entropy_is_too_low(line, excess):
    config = settings(line).agent
    agent = sac.init(jax.random.key(0), config)
    tuned = sac._tune(agent, jnp.asarray(sac.target_entropy(config.action_space) + excess), config)
    assert float(tuned.log_temperature - agent.log_temperature) * excess < 0


def test_tuned_temperature_is_used(line):
    config = settings(line.replace(tune_temperature=True, temperature=0.3, reward_scale=0.5)).agent
    agent = sac.init(jax.random.key(0), config)
    noise = sac.draw_noise(jax.random.key(1), (2,), config)
    after, info = jax.jit(sac.update)(agent, two_transitions(), 99.0, noise, config)
    np.testing.assert_allclose(info["temperature"], 0.15, rtol=1e-5)
    assert float(after.log_temperature) != float(agent.log_temperature)


# -- values in closed form ---------------------------------------------------------------------------------------------

GAMMA = 0.5


def probe(line, environment, temperature=0.0, **params):
    """A short SAC training on a probe, with one temperature from start to end."""
    params = ProbeParams(**params)
    return line.replace(
        env=environment, params=params, belief=params, method="sac", gamma=GAMMA, temperature=temperature,
        initial_temperature=temperature, total_steps=640, num_envs=8, rollout_length=8, warmup_steps=320, batch_size=64,
        updates_per_step=0.8, learning_rate=1e-2, target_rate=0.1, hidden_sizes=(32,),
    )  # fmt: skip


def values(result, observation, action):
    """Both critics' Q, for rows of observations and actions."""
    head, _, network = sac.networks(result.training.settings.agent)
    return head.critics(network, result.agents[0].critics, jnp.asarray(observation), jnp.asarray(action))


def test_probe_constant_reward(line, train):
    result = train(probe(line, Probe(horizon=1), last=2.0))
    np.testing.assert_allclose(values(result, [[0.0]] * 3, [[-0.8], [0.0], [0.8]]), 2.0, atol=0.1)


def test_probe_bootstraps_through_a_time_limit(line, train):
    result = train(probe(line, Probe(horizon=1, ends=False), last=2.0))
    np.testing.assert_allclose(values(result, [[0.0]] * 3, [[-0.8], [0.0], [0.8]]), 2.0 / (1 - GAMMA), atol=0.2)


def test_probe_two_steps_discount(line, train):
    result = train(probe(line, Probe(horizon=2), last=2.0))
    np.testing.assert_allclose(values(result, [[0.0]], [[0.3]]), 2.0 * GAMMA, atol=0.1)
    np.testing.assert_allclose(values(result, [[1.0]], [[0.3]]), 2.0, atol=0.1)


def test_probe_reward_depends_on_the_action(line, train):
    result = train(probe(line, Probe(horizon=1), last=0.0, choice=2.0))
    actions = jnp.array([[-0.8], [0.0], [0.8]])
    quality = [[2.0 * (1 - 0.25 * (action - 1) ** 2) for action in (-0.8, 0.0, 0.8)]] * 2
    np.testing.assert_allclose(values(result, jnp.zeros((3, 1)), actions), quality, atol=0.25)
    assert float(result.act(jnp.zeros(1))[0]) > 0.7


def test_probe_discrete_actions_and_the_soft_policy(line, train):
    temperature, gap = 0.5, 1.0
    environment = Probe(horizon=1, action_space=Discrete(3))
    result = train(probe(line, environment, temperature=temperature, last=0.0, choice=gap))
    quality = np.array([0.0, 0.5, 1.0]) * gap
    np.testing.assert_allclose(values(result, jnp.zeros((3, 1)), jnp.arange(3)), [quality] * 2, atol=0.1)
    _, network, _ = sac.networks(result.training.settings.agent)
    probabilities = jax.nn.softmax(network.apply(result.agents[0].policy, jnp.zeros(1)))
    expected = np.exp(quality / temperature) / np.exp(quality / temperature).sum()  # pi ~ exp(Q / alpha)
    np.testing.assert_allclose(probabilities, expected, atol=0.06)
    assert int(result.act(jnp.zeros(1))) == 2


def test_probe_discrete_two_steps_with_soft_values(line, train):
    temperature = 0.5
    environment = Probe(horizon=2, action_space=Discrete(3))
    result = train(probe(line, environment, temperature=temperature, last=2.0, choice=1.0))
    last = 2.0 + np.array([0.0, 0.5, 1.0])
    value = temperature * np.log(np.mean(np.exp(last / temperature)))  # relative to the uniform policy: a mean, no sum
    np.testing.assert_allclose(values(result, jnp.ones((3, 1)), jnp.arange(3)), [last] * 2, atol=0.15)
    first = np.array([0.0, 0.5, 1.0]) + GAMMA * value
    np.testing.assert_allclose(values(result, jnp.zeros((3, 1)), jnp.arange(3)), [first] * 2, atol=0.15)
