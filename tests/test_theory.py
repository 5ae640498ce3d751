"""What the paper's Sec. 4 says, checked: the metric's decomposition, what r-hat carries, and what is left without bias."""

import dataclasses
import itertools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from conftest import settings
from flax import struct
from jax import Array
from scipy.stats import spearmanr

import peps_envs
from peps_envs import Discrete, Environment, PerceivedDensity, Step
from peps_jax import Config, rollout
from peps_jax.config import Problem
from peps_jax.evaluate import evaluate_policy
from peps_jax.learning import policy_heads, surrogate
from peps_jax.preferences import data, queries, synthetic_human

# --- Eq. (4) --------------------------------------------------------------------------------------------------------------

STATES, ACTIONS, HORIZON = 3, 2, 3


class ChainParams(NamedTuple):
    """A small MDP as tables."""

    dynamics: Array  # (STATES, ACTIONS, STATES) probabilities
    rewards: Array  # (STATES, ACTIONS, STATES)


@struct.dataclass
class ChainState:
    """Where, and when."""

    place: Array
    time: Array


@struct.dataclass
class Places(PerceivedDensity):
    """Places so far apart that nobody confuses two of them: l is the logarithm of a probability."""

    probabilities: Array

    def relative_log_prob(self, perceived: Array) -> Array:
        return jnp.log(self.probabilities[perceived[0].astype(jnp.int32)])

    def sample(self, key: Array) -> Array:
        return jax.random.categorical(key, jnp.log(self.probabilities)).astype(jnp.float32)[None]

    relative_entropy = None


@dataclasses.dataclass(frozen=True)
class Chain(Environment):
    """Three places, two actions, three steps, chance in every one."""

    horizon: int = HORIZON
    observation_size = 1
    action_space = Discrete(ACTIONS)

    def reset(self, key: Array, params: ChainParams) -> tuple[ChainState, Array]:
        state = ChainState(jnp.zeros((), jnp.int32), jnp.zeros((), jnp.int32))
        return state, self.perceive(state)

    def step(self, key: Array, state: ChainState, action: Array, params: ChainParams) -> Step:
        place = jax.random.categorical(key, jnp.log(params.dynamics[state.place, action]))
        after = ChainState(place.astype(jnp.int32), state.time + 1)
        over = after.time >= self.horizon
        reward = self.reward(state, action, after, params)
        return Step(after, self.perceive(after), reward, jnp.zeros((), bool), over, jnp.zeros(0, bool))

    def reward(self, state: ChainState, action: Array, next_state: ChainState, params: ChainParams) -> Array:
        return params.rewards[state.place, action, next_state.place]

    def next_state_distribution(self, state: ChainState, action: Array, params: ChainParams) -> Places:
        return Places(params.dynamics[state.place, action])

    def perceive(self, state: ChainState) -> Array:
        return state.place.astype(jnp.float32)[None]

    def perception_width(self, params: ChainParams) -> Array:
        return jnp.ones(1)


def chain(seed: int) -> tuple[ChainParams, np.ndarray]:
    """Random dynamics and rewards, and the same as float64 tables."""
    random = np.random.default_rng(seed)
    dynamics = random.dirichlet(np.ones(STATES), (STATES, ACTIONS))
    rewards = random.normal(size=(STATES, ACTIONS, STATES))
    return ChainParams(*(jnp.asarray(table, jnp.float32) for table in (dynamics, rewards))), (dynamics, rewards)


def test_the_metric_is_the_divergence_of_eq_3():
    """-KL(p_A || p_H) = E[sum r_H + sum (l_H - l_A) - sum log pi] - log Z, with p_H of Eq. (2) and Z its sum over trajectories.

    The left side is summed over all trajectories, the right side is the mean over evaluated episodes.
    """
    (params, (true, _)), (belief, (believed, wanted)) = chain(0), chain(1)
    logits = np.random.default_rng(2).normal(size=(STATES, ACTIONS))
    policy = np.exp(logits) / np.exp(logits).sum(-1, keepdims=True)
    log_agent, log_human = [], []
    for steps in itertools.product(itertools.product(range(ACTIONS), range(STATES)), repeat=HORIZON):
        place, agent, expected = 0, 0.0, 0.0
        for action, after in steps:
            agent += np.log(policy[place, action] * true[place, action, after])
            expected += np.log(believed[place, action, after]) + wanted[place, action, after]
            place = after
        log_agent.append(agent)
        log_human.append(expected)
    log_agent, log_human = np.array(log_agent), np.array(log_human)
    np.testing.assert_allclose(np.exp(log_agent).sum(), 1.0)
    log_normaliser = np.log(np.exp(log_human).sum())
    divergence = np.sum(np.exp(log_agent) * (log_agent - (log_human - log_normaliser)))

    head = policy_heads.discrete_head(1, ACTIONS)
    table = jnp.asarray(logits, jnp.float32)
    act = lambda observation, key: head.sample(table[observation[0].astype(jnp.int32)], head.noise(key, ()))
    roll = lambda key: evaluate_policy(act, Problem(Chain(), params, belief), key, 40_000, stochastic=True)
    episodes = jax.jit(roll)(jax.random.key(0))
    # l_pi is relative to the uniform policy: log pi = l_pi - log ACTIONS
    found = np.asarray(episodes.explicability_with_policy, np.float64) + HORIZON * np.log(ACTIONS) - log_normaliser
    error = found.std() / np.sqrt(found.size)
    assert abs(found.mean() + divergence) < 4 * error
    assert 4 * error < 0.05 * divergence, "the check is sharp"


# --- r-hat ----------------------------------------------------------------------------------------------------------------


@jax.jit
def taught_by_random_walks(config):
    """r-hat, l_H, r_H and r_A of every step of random walks, after answers about pieces of them."""
    key_actors, key_act, key_hold, key_pairs, key_answer, key_init, _, key_fit = jax.random.split(jax.random.key(0), 8)
    problem, own = config.problem(), settings(config)

    def act(observation, key, time):
        held = jax.random.fold_in(key_hold, time // config.hold_steps)
        return jax.random.uniform(held, (config.num_envs, 2), minval=-1.0)

    _, walk, _ = rollout.collect(rollout.init(key_actors, problem, own.rollout), act, key_act, problem, own.rollout)
    pairs = jax.tree.map(lambda rows: rows[: config.num_queries], queries.candidates(walk, key_pairs, own.queries))
    asked = data.Queries(jnp.arange(config.num_queries, dtype=jnp.int32), pairs)
    preferences = data.recording(pairs, synthetic_human.answer(key_answer, asked, problem, own.human))
    state, _ = surrogate.fit(surrogate.init(key_init, own.surrogate), preferences, key_fit, own.surrogate)
    seen = jax.tree.map(lambda rows: rows.reshape(-1, *rows.shape[2:]), walk)
    steps = seen.transition
    weigh = jax.vmap(lambda *step: synthetic_human.log_weight(problem.environment, problem.belief, *step))
    expected, wanted = weigh(seen.state, steps.action, seen.next_state)
    learned = surrogate.predict(state, steps.observation, steps.action, steps.reward, own.surrogate)
    return learned, expected, wanted, steps.reward


def walks(belief):
    """`taught_by_random_walks` on D1, for a human of that belief."""
    config = Config(
        env="nav-d1", method="peps", num_envs=32, rollout_length=100, total_steps=3200, num_queries=1500, segment_length=5,
        min_segment_length=2, surrogate_updates=600, surrogate_batch_size=128, model_hidden_sizes=(32, 32),
    )  # fmt: skip
    # by value: one program for every belief
    return map(np.asarray, taught_by_random_walks(config.replace(belief=peps_envs.make("nav-d1").beliefs[belief])))


def test_with_both_biases_the_surrogate_reward_carries_both():
    """It ranks steps like l_H + r_H: less like what is true of them, and less like either bias by itself."""
    predicted, expected, wanted, reward = walks("both")
    like = lambda truth: spearmanr(predicted, truth).statistic
    assert like(expected + wanted) > 0.7
    assert like(expected + wanted) > max(like(reward), like(wanted), like(expected)) + 0.02


def test_with_a_biased_reward_the_surrogate_reward_is_the_humans():
    """In units too: unequal lengths pin its level, and Eq. (2) its scale. (r_H ranks steps as r_A does, so ranks can't tell.)"""
    predicted, expected, wanted, reward = walks("reward")
    np.testing.assert_array_equal(expected, 0.0)
    error = lambda truth: np.median(np.abs(predicted - truth))
    assert spearmanr(predicted, wanted).statistic > 0.7
    assert error(wanted) < 0.6 * error(reward)


# --- without bias ---------------------------------------------------------------------------------------------------------


def test_without_bias_explicability_is_the_return():
    """l_H = l_A in every step of a domain with chance in it, so that only r_H = r_A is left of Eq. (4)."""
    task = peps_envs.make("nav-d3")

    def walk(observation, key):
        return jax.random.uniform(key, (2,), minval=-1.0), jnp.zeros(())

    roll = lambda belief: evaluate_policy(
        walk, Problem(task.environment, task.params, belief), jax.random.key(0), 16, stochastic=True
    )
    rolled = jax.jit(roll)
    unbiased, biased = rolled(task.beliefs["unbiased"]), rolled(task.beliefs["biased"])
    assert float(unbiased.log_true.min()) < -1.0, "sand holds on to the agent by chance"
    np.testing.assert_array_equal(unbiased.belief_gap, 0.0)
    np.testing.assert_array_equal(unbiased.explicability, unbiased.return_)
    assert float(biased.belief_gap.min()) < -1.0
