"""The methods: what each learns from, in which domain, and how its policies act together."""

import math

import chex
import distrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import LineParams, Probe, ProbeParams, settings

import peps_jax
from peps_envs import Box, Discrete
from peps_jax import Config, methods
from peps_jax.learning import classifier, dynamics, policy_heads, sac, team
from peps_jax.learning.policy_heads import Gaussian
from peps_jax.methods import Method
from peps_jax.round import round_at
from peps_jax.train import collect_and_ask, init, prepare
from peps_jax.trajectory import Transition

EVERY = ("peps", "sac", "drlhp", "policy_shaping", "oracle", "darc", "human_expectation")
EPISODES = 6


@pytest.fixture(scope="module")
def evaluate():
    return jax.jit(peps_jax.evaluate, static_argnames=("num_episodes", "stochastic"))


def test_the_methods_and_their_order():
    assert tuple(methods.METHODS) == EVERY
    text = Config.__dataclass_fields__["method"].metadata["help"]
    places = [
        text.index(name) for name in ("peps", " sac", "drlhp", "policy_shaping", "oracle", "darc", "human_expectation")
    ]
    assert places == sorted(places)
    assert [name for name in EVERY if methods.get(name).uses_lam] == ["peps", "oracle", "darc"]


def test_absolute_entropies_are_more_by_those_of_what_relative_ones_are_measured_against(tiny):
    problem, method = tiny.problem(), methods.get("peps")
    knowledge = method.init(jax.random.key(0), settings(tiny))
    observation = jnp.zeros(problem.environment.observation_size)
    nothing = jnp.zeros(())
    step = Transition(
        observation, jnp.zeros(2), nothing, observation, jnp.zeros(2), jnp.zeros((), bool), nothing, nothing
    )
    reward = lambda kind: method.rewards[0](knowledge, step, settings(tiny.replace(lam=2.0, entropies=kind)))
    absolute, relative = reward("absolute"), reward("relative")
    kernel = distrax.MultivariateNormalDiag(
        jnp.zeros(2), problem.environment.perception_width(problem.params)
    ).entropy()
    uniform = distrax.Independent(distrax.Uniform(-jnp.ones(2), jnp.ones(2)), 1).entropy()
    np.testing.assert_allclose(absolute - relative, 2.0 * (kernel + tiny.policy_entropy_weight * uniform), rtol=1e-4)


@pytest.mark.parametrize("space", [Box(2), Discrete(3)])
def test_what_absolute_entropies_are_more_by_has_a_closed_form(line, space):
    """n/2 log(2 pi e) + sum_i log sigma_p,i of the kernel, m log 2 or log actions of the uniform policy, each at its weight."""
    line = line.replace(
        env=Probe(action_space=space), params=ProbeParams(), belief=ProbeParams(),
        environment_entropy_weight=0.7, policy_entropy_weight=0.4,
    )  # fmt: skip
    kernel = 0.5 * math.log(2 * math.pi * math.e)  # one perceived number, of width 1
    uniform = 2 * math.log(2) if space == Box(2) else math.log(3)
    offset = lambda config: settings(config).objective.entropy_offset
    np.testing.assert_allclose(offset(line.replace(entropies="absolute")), 0.7 * kernel + 0.4 * uniform, rtol=1e-6)
    assert offset(line) == 0
    assert offset(line.replace(entropies="relative")) == 0


def test_the_kernels_entropy_follows_from_its_width(line):
    absolute = line.replace(entropies="absolute")
    offset = lambda width: settings(absolute.replace(params=LineParams(width=width))).objective.entropy_offset
    np.testing.assert_allclose(offset(0.5) - offset(0.1), math.log(5), rtol=1e-5)


# --- defaults -------------------------------------------------------------------------------------------------------------


def test_a_method_is_by_default_one_that_learns_nothing_beside_and_acts_in_the_true_domain(line):
    method, problem, own = Method("nothing", rewards=()), line.problem(), settings(line)
    assert not method.uses_lam
    assert not method.asks
    assert method.acts_in(problem) is problem
    assert method.settings(own) is own
    knowledge = method.init(jax.random.key(0), own)
    assert jax.tree.leaves(knowledge) == []
    assert method.learn(knowledge, None, None, None, own) == (knowledge, {})
    assert method.entropy_weight(own) == 0
    assert method.surrogate(knowledge) is None


@pytest.mark.parametrize("name", EVERY)
def test_who_asks_learns_a_surrogate_reward_and_nobody_else(line, name):
    method = methods.get(name)
    knowledge = method.init(jax.random.key(0), settings(line))
    found = method.surrogate(knowledge)
    assert method.asks == (name in ("peps", "drlhp", "policy_shaping"))
    assert (found is None) == (not method.asks)
    assert found is None or found is knowledge.surrogate
    assert (method.ask is None) == (not method.asks)


def test_drlhp_has_its_own_likelihood_and_regularisation_and_the_level_that_is_asked_for(line):
    told = lambda **changes: settings(line.replace(**changes)).surrogate
    everyones, drlhp = told(), told(method="drlhp")
    assert (everyones.uniform_answers, everyones.validates) == (0.0, False)
    assert (drlhp.uniform_answers, drlhp.validates) == (0.1, True)
    assert (everyones.prior, drlhp.prior) == ("observed", "none")
    assert drlhp.replace(uniform_answers=0.0, validates=False, prior="observed") == everyones
    assert told(method="drlhp", level="standard").level == "standard"
    assert Config().level == everyones.level == drlhp.level == "none"


# --- the product of policies ----------------------------------------------------------------------------------------------


def test_opposed_discrete_policies_make_one_that_is_sure_of_nothing():
    """(0.1, 0.9) x (0.9, 0.1) -> (0.5, 0.5)  (the paper, Sec. 5.1)."""
    head = policy_heads.discrete_head(1, 2)
    product = lambda *policies: jax.nn.softmax(head.product(jnp.log(jnp.array(policies)) + 3.0))  # logits have no level
    np.testing.assert_allclose(product((0.1, 0.9), (0.9, 0.1)), [0.5, 0.5], rtol=1e-6)
    np.testing.assert_allclose(product((0.1, 0.9), (0.5, 0.5)), [0.1, 0.9], rtol=1e-6)
    np.testing.assert_allclose(product((0.2, 0.8), (0.4, 0.6)), [0.08 / 0.56, 0.48 / 0.56], rtol=1e-5)


def policies(means, sds) -> Gaussian:
    return Gaussian(jnp.array(means, jnp.float32), jnp.log(jnp.array(sds, jnp.float32)))


def test_continuous_policies_are_weighed_by_their_precision():
    head = policy_heads.continuous_head(1, 2)
    mean, log_sd = head.product(policies([[1.0, -2.0], [-1.0, 1.0]], [[0.5, 0.3], [1.0, 0.3]]))
    precision = np.array([[4.0, 1 / 0.09], [1.0, 1 / 0.09]])
    np.testing.assert_allclose(np.exp(log_sd), precision.sum(0) ** -0.5, rtol=1e-5)
    np.testing.assert_allclose(mean, [(4.0 - 1.0) / 5.0, -0.5], rtol=1e-5)


def test_the_product_is_that_of_the_densities_before_tanh():
    head = policy_heads.continuous_head(1, 1)
    places = np.linspace(-6, 6, 4001)
    density = lambda mean, sd: np.exp(-0.5 * ((places - mean) / sd) ** 2) / sd
    product = density(0.7, 0.6) * density(-0.4, 0.9)
    product /= np.trapezoid(product, places)
    mean, log_sd = head.product(policies([[0.7], [-0.4]], [[0.6], [0.9]]))
    expected = density(mean[0], np.exp(log_sd[0])) / np.sqrt(2 * np.pi)
    np.testing.assert_allclose(expected, product, atol=1e-4)


@pytest.mark.parametrize("sds", [(1e-3, 1e-3), (1e3, 1e3), (1e-3, 1e3)])
def test_products_of_extreme_policies_are_exact(sds):
    head = policy_heads.continuous_head(1, 1)
    stacked = policies([[20.0], [-20.0]], [[sds[0]], [sds[1]]])
    mean, log_sd = head.product(stacked)
    precision = np.array(sds) ** -2.0
    np.testing.assert_allclose(log_sd, [-0.5 * np.log(precision.sum())], rtol=1e-5)
    np.testing.assert_allclose(mean, [20.0 * (precision[0] - precision[1]) / precision.sum()], rtol=1e-5, atol=1e-4)
    chex.assert_tree_all_finite(jax.jacobian(lambda stacked: head.product(stacked))(stacked))


@pytest.mark.parametrize("space", ["continuous", "discrete"])
def test_one_agent_acts_by_itself_and_two_by_their_product(line, space):
    if space == "discrete":
        line = line.replace(env=Probe(action_space=Discrete(3)), params=ProbeParams(), belief=ProbeParams())
    own = settings(line.replace(product="gaussians")).agent
    parts, network, _ = sac.networks(own)
    agents = tuple(sac.init(jax.random.key(seed), own) for seed in range(2))
    observations = jnp.linspace(-1.0, 1.0, 5)[:, None]
    each = [parts.policy(network.apply(agent.policy, observations)) for agent in agents]
    chex.assert_trees_all_equal(team.acting_policy(agents[:1], observations, own), each[0])
    together = team.acting_policy(agents, observations, own)
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *each)
    chex.assert_trees_all_close(together, jax.vmap(parts.product, in_axes=1)(stacked), rtol=1e-5, atol=1e-6)
    action, ratio = team.mode(agents, observations, own)
    np.testing.assert_array_equal(action, parts.mode(together)[0])
    np.testing.assert_allclose(ratio, parts.log_ratio(together, action), rtol=1e-4, atol=1e-5)
    sampled, ratio = team.act(agents, observations, jax.random.key(0), own)
    np.testing.assert_allclose(ratio, parts.log_ratio(together, sampled), rtol=1e-2, atol=1e-3)


# --- what each learns -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("method", EVERY)
def test_every_method_learns_and_acts(line, train, evaluate, method):
    result = train(line.replace(method=method))
    assert len(result.agents) == (2 if method == "policy_shaping" else 1)
    chex.assert_tree_all_finite((result.agents, result.knowledge))
    assert result.act(jnp.zeros(1)).shape == (1,)
    asks = method in ("peps", "drlhp", "policy_shaping")
    assert (result.surrogate is not None) == asks
    assert ("surrogate_loss" in result.curves) == asks
    assert ("dynamics_loss" in result.curves) == (method in ("peps", "oracle"))
    if asks:
        assert int(result.preferences.weight.sum()) == line.num_queries
    evaluation = evaluate(result, num_episodes=EPISODES)
    assert evaluation.explicability.shape == (EPISODES,)
    assert bool(jnp.all(jnp.isfinite(evaluation.explicability)))


@pytest.mark.parametrize("method", ["sac", "drlhp", "policy_shaping", "human_expectation"])
def test_lam_changes_nothing_of_a_method_without_it(line, train, method):
    one, two = (train(line.replace(method=method, lam=lam)).agents for lam in (0.5, 2.4))
    chex.assert_trees_all_equal(one, two)


def test_drlhp_does_not_see_the_environments_reward(line, train):
    line = line.replace(method="drlhp")
    one, two = (train(line.replace(params=LineParams(slope=slope))) for slope in (1.0, -5.0))
    chex.assert_trees_all_equal(one.agents, two.agents)
    other = train(line.replace(belief=LineParams(noise=0.1, slope=-5.0)))
    assert not np.allclose(other.preferences.preferred, one.preferences.preferred)


def test_policy_shaping_learns_one_policy_of_each_reward(line, train):
    line = line.replace(
        method="policy_shaping", product="gaussians", exploration=1.0
    )  # all actions are random: the same data for both
    one, two = (train(line.replace(params=LineParams(slope=slope))).agents for slope in (1.0, -5.0))
    chex.assert_trees_all_equal(one[1], two[1])
    assert not np.allclose(jax.tree.leaves(one[0].critics)[0], jax.tree.leaves(two[0].critics)[0])
    alone = train(line.replace(method="sac", params=LineParams(slope=1.0))).agents[0]
    chex.assert_trees_all_close(one[0], alone, rtol=1e-4, atol=1e-5)


def test_policy_shaping_acts_by_the_product_of_gaussians(line, train):
    result = train(line.replace(method="policy_shaping", product="gaussians"))
    head, network, _ = sac.networks(result.training.settings.agent)
    observation = jnp.array([0.3])
    each = [head.policy(network.apply(agent.policy, observation)) for agent in result.agents]
    product = head.product(jax.tree.map(lambda *leaves: jnp.stack(leaves), *each))
    np.testing.assert_allclose(result.act(observation), head.mode(product)[0], rtol=1e-6)


def test_the_product_and_each_policy_act_in_environments_of_their_own(line):
    line = line.replace(method="policy_shaping", product="gaussians", warmup_steps=0, exploration=0.0)
    training = prepare(line)
    state = init(training)
    agents = []
    for agent, push in zip(state.agents, (5.0, -5.0), strict=True):
        policy = jax.tree.map(jnp.zeros_like, agent.policy)
        policy["params"]["Dense_1"]["bias"] = jnp.array([push, -0.5])
        agents.append(agent.replace(policy=policy))
    state = state.replace(agents=tuple(agents))
    now = round_at(jnp.asarray(0), state.key, training.settings.schedule)
    state, _, _ = jax.jit(collect_and_ask)(state, now, training)
    by_env = state.replay.action[: line.steps_per_round].reshape(-1, line.num_envs)
    assert bool(jnp.all(by_env[:, 1] > 0.9))
    assert bool(jnp.all(by_env[:, 2] < -0.9))
    assert abs(float(jnp.mean(by_env[:, [0, 3]]))) < 0.3, "the two cancel"


@pytest.mark.parametrize("space", [Box(1), Discrete(3)])
def test_policy_shaping_behaves_in_thirds(line, space):
    """The product, the first policy and the second one act in every third environment, each with its own chance."""
    line = line.replace(env=Probe(action_space=space), params=ProbeParams(), belief=ProbeParams())
    own = settings(line.replace(product="gaussians")).agent
    # outputs of two policies that are sure of opposite actions; of the third one of three neither is
    outputs = ([1.0, -0.5], [-1.0, -0.5]) if space == Box(1) else ([3.0, 0.0, -3.0], [0.0, 3.0, -3.0])
    agents = ()
    for output in outputs:
        agent = sac.init(jax.random.key(0), own)
        policy = jax.tree.map(jnp.zeros_like, agent.policy)
        policy["params"]["Dense_1"]["bias"] = jnp.array(output)
        agents = (*agents, agent.replace(policy=policy))
    observations, key = jnp.zeros((3001, 1)), jax.random.key(7)  # no multiple of 3
    acted = np.asarray(methods.get("policy_shaping").behave(agents, observations, key, own))
    assert acted.shape == ((3001, 1) if space == Box(1) else (3001,))
    edges = np.linspace(-1, 1, 21) if space == Box(1) else np.arange(4) - 0.5
    share = lambda actions: np.histogram(actions, edges)[0] / actions.size
    for third, some in enumerate((agents, agents[:1], agents[1:])):
        expected = np.asarray(team.act(some, observations, jax.random.key(8), own)[0])
        np.testing.assert_allclose(share(acted[third::3]), share(expected), atol=0.07)
        assert len(np.unique(acted[third::3])) > 1
    together = methods.get("peps").behave(agents, observations, key, own)
    np.testing.assert_array_equal(together, team.act(agents, observations, key, own)[0])


def test_the_oracle_is_told_what_the_human_thinks(line):
    """Of l_H = -log(1 + (0.1 / 0.1)^2) / 2, where the belief's mean happens, and r_H = -2 s'; they stand in r-hat's place."""
    training = prepare(line.replace(method="oracle", belief=LineParams(noise=0.1, slope=-2.0)))
    state = init(training)
    now = round_at(jnp.asarray(0), state.key, training.settings.schedule)
    state, asked, _ = jax.jit(collect_and_ask)(state, now, training)
    assert asked is None
    rows = jax.tree.map(lambda rows: rows[: line.steps_per_round], state.replay)
    expected = -0.5 * math.log(2) - 2.0 * rows.next_observation[:, 0]
    np.testing.assert_allclose(rows.log_belief + rows.human_reward, expected, rtol=1e-4, atol=1e-5)
    assert rows.imagined is None
    entropy = dynamics.environment_entropy(
        state.knowledge.dynamics, rows.observation, rows.action, training.settings.dynamics
    )
    np.testing.assert_allclose(
        training.method.rewards[0](state.knowledge, rows, training.settings),
        rows.next_observation[:, 0] + line.lam * (expected + entropy), rtol=1e-4, atol=1e-4,
    )  # fmt: skip


def test_darc_is_told_the_humans_reward_and_what_the_human_imagines(line):
    """Movements as they are on average, spread by the belief's 0.1 and the kernel's 0.1: by sqrt 2 kernels."""
    training = prepare(line.replace(method="darc", belief=LineParams(noise=0.1, slope=-2.0), total_steps=2_000))
    state = init(training)
    now = round_at(jnp.asarray(0), state.key, training.settings.schedule)
    state, asked, _ = jax.jit(collect_and_ask)(state, now, training)
    assert asked is None
    rows = jax.tree.map(lambda rows: rows[: line.steps_per_round], state.replay)
    off = np.asarray(rows.imagined - rows.action)
    assert off.shape == (line.steps_per_round, 1)
    error = 4 * math.sqrt(2 / off.size)
    assert abs(off.mean()) < error
    assert abs(off.std() - math.sqrt(2)) < error
    np.testing.assert_allclose(
        training.method.rewards[0](state.knowledge, rows, training.settings),
        rows.reward + line.lam * (
            rows.human_reward + classifier.log_ratio(state.knowledge.classifier, rows, training.settings.dynamics)
        ), rtol=1e-5,
    )  # fmt: skip


def test_the_human_acts_in_the_believed_domain(line, train, evaluate):
    belief = LineParams(noise=0.05, slope=-2.0)
    line = line.replace(method="human_expectation", belief=belief)
    result = train(line)
    ended = np.asarray(result.curves["episodes"]) > 0
    for name in ("human_return", "explicability"):
        np.testing.assert_allclose(result.curves[name][ended], result.curves["return_"][ended], rtol=1e-5)
    imagined = evaluate(result, num_episodes=EPISODES, stochastic=True)
    np.testing.assert_allclose(imagined.belief_gap, 0.0, atol=1e-5)
    np.testing.assert_allclose(imagined.explicability, imagined.return_, rtol=1e-5)
    # what happened is the belief: its noise, and its reward
    places = imagined.perceived[..., 0]
    np.testing.assert_allclose(imagined.return_[0], -2.0 * places[0, 1 : 1 + int(imagined.length[0])].sum(), rtol=1e-4)
    true = evaluate(result, num_episodes=EPISODES, problem=line.problem())
    np.testing.assert_allclose(true.human_return, -2.0 * true.return_, rtol=1e-4)


def test_the_human_of_a_true_belief_is_sac(line, train):
    line = line.replace(belief=line.params)
    human, sac_ = train(line.replace(method="human_expectation")), train(line.replace(method="sac"))
    chex.assert_trees_all_close(human.agents, sac_.agents, rtol=1e-4, atol=1e-5)


def test_drlhp_as_its_authors_normalised_it(line, train):
    result = train(line.replace(method="drlhp", level="standard"))
    state, config = result.surrogate, result.config
    assert state.shift.shape == state.scale.shape == (config.ensemble_size,)
    assert len(set(np.asarray(state.scale).tolist())) == config.ensemble_size
    assert "surrogate_validation_ratio" in result.curves
    assert not np.allclose(state.decay, config.surrogate_decay)
    unscaled = train(line.replace(method="drlhp"))
    np.testing.assert_array_equal(unscaled.surrogate.shift, 0.0)
    np.testing.assert_array_equal(unscaled.surrogate.scale, 1.0)
    assert "surrogate_validation_ratio" in unscaled.curves
