"""A training: the paper's Algorithm 1 as one pure function of a `Config`.

`train` scans over rounds. A round has two halves with the teacher between them: `collect_and_ask` ends with queries,
`learn_and_improve` begins with preferences. A host loop may run rounds one by one (`run_round`), or the halves with a person
in between, and gets the same numbers as the scan.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jax import Array

from peps_jax import methods, rollout
from peps_jax.config import Config
from peps_jax.learning import replay, sac
from peps_jax.preferences import synthetic_human
from peps_jax.trajectory import Preferences, Segments, Transition

# Minibatches whose rewards are computed at once. All of a round's took two to three times as long on a CPU: what the ensembles'
# layers put out didn't stay in the cache.
VALUED_TOGETHER = 5


@struct.dataclass
class TrainingState:
    """All of a training between two rounds, random key included."""

    agents: tuple[sac.Agent, ...]  # one for each of the method's rewards; they act together
    knowledge: Any  # what the method learns beside the policies
    replay: Transition
    actors: rollout.Actors
    key: Array


@struct.dataclass
class Result:
    """A finished training, ready to act."""

    agents: tuple[sac.Agent, ...]
    knowledge: Any
    curves: dict[str, Array]  # (rounds,) each
    config: Config

    def act(self, observation: Array, key: Array | None = None) -> Array:
        """The action for one observation: the policy's mode, or a sample if a key is given."""
        return self.policy()(observation, key)[0]

    def policy(self) -> Callable[[Array, Array | None], tuple[Array, Array]]:
        """(observation, key or None) -> the action and l_pi, log pi(a|s) relative to the uniform policy."""

        def policy(observation: Array, key: Array | None) -> tuple[Array, Array]:
            if key is None:
                return sac.mode(self.agents, observation, self.config)
            return sac.act(self.agents, observation, key, self.config)

        return policy


def check(config: Config) -> None:
    """Raises ValueError, in one line, for the first setting that makes no sense."""
    methods.get(config.method)
    config.check()


def init(config: Config) -> TrainingState:
    """The state before the first round."""
    key_agent, key_knowledge, key_actors, key = jax.random.split(jax.random.key(config.seed), 4)
    environment, _, _ = config.task()
    method = methods.get(config.method)
    return TrainingState(
        agents=tuple(sac.init(key, config) for key in _keys(key_agent, len(method.rewards))),
        knowledge=method.init(key_knowledge, config),
        replay=replay.init(config.num_rounds * config.steps_per_round, environment),
        actors=rollout.init(key_actors, config),
        key=key,
    )


def collect_and_ask(
    state: TrainingState, index: Array, config: Config
) -> tuple[TrainingState, Segments | None, dict[str, Array]]:
    """The first half of round `index`: act, remember, and choose what to ask. Queries are None from a method that asks nothing."""
    key_act, key_ask, _, _, _ = _round_keys(state, index)
    key_act, key_hold = jax.random.split(key_act)
    parts, _, _ = sac.networks(config)
    env = jnp.arange(config.num_envs)
    # Where several policies act together, each acts alone too, in environments of its own: SAC goes astray with a policy
    # whose actions it never sees carried out.
    alone = [(agent,) for agent in state.agents]
    teams = alone if len(alone) == 1 else [state.agents, *alone]

    def act(observation: Array, key: Array, time: Array) -> Array:
        keys = _keys(key, len(teams))
        actions = [sac.act(team, observation, key, config)[0] for team, key in zip(teams, keys, strict=True)]
        action = jnp.stack(actions, 1)[env, env % len(teams)]
        # A random action is held: a walk that turns at every step hardly leaves the start. Some are taken to the very end:
        # what the policy has abandoned would otherwise never be seen, asked about and valued again.
        key_uniform, key_explore = jax.random.split(jax.random.fold_in(key_hold, time // config.hold_steps))
        uniform = jax.vmap(parts.uniform)(jax.random.split(key_uniform, config.num_envs))
        exploring = jax.random.uniform(key_explore, (config.num_envs,)) < config.exploration
        return jax.vmap(jnp.where)(exploring | (index < config.warmup_rounds), uniform, action)

    actors, trajectory, info = rollout.collect(state.actors, act, key_act, config)
    flat = jax.tree.map(lambda rows: rows.reshape(-1, *rows.shape[2:]), trajectory.transition)
    buffer = replay.add(state.replay, flat, index * config.steps_per_round)
    queries = methods.get(config.method).ask(state.knowledge, trajectory, key_ask, config)
    return state.replace(actors=actors, replay=buffer), queries, info


def learn_and_improve(
    state: TrainingState, index: Array, preferences: Preferences | None, config: Config
) -> tuple[TrainingState, dict[str, Array]]:
    """The second half of round `index`: learn from replay and preferences, then improve the policy."""
    _, _, _, key_learn, key_improve = _round_keys(state, index)
    filled = (index + 1) * config.steps_per_round
    knowledge, learned = methods.get(config.method).learn(
        state.knowledge, state.replay, filled, preferences, index, key_learn, config
    )
    state = state.replace(knowledge=knowledge)
    agents, improved = improve(state, index, key_improve, config)
    return state.replace(agents=agents), learned | improved


def improve(
    state: TrainingState, index: Array, key: Array, config: Config
) -> tuple[tuple[sac.Agent, ...], dict[str, Array]]:
    """SAC updates of one round: every agent sees the same minibatches, with its own reward by what the method knows now."""
    method = methods.get(config.method)
    key_batch, key_update = jax.random.split(key)
    filled = (index + 1) * config.steps_per_round
    shape = (config.updates_per_round, config.batch_size)
    batches = replay.sample(state.replay, key_batch, shape, filled)
    temperature = (annealed_temperature(index, config) + method.entropy_weight(config)) * config.reward_scale

    slower = config.replace(learning_rate=faded_learning_rate(index, config))

    def update(agent: sac.Agent, step: tuple[Transition, sac.Noise]) -> tuple[sac.Agent, dict[str, Array]]:
        batch, noise = step
        return sac.update(agent, batch, temperature, noise, slower)

    agents, infos = [], []
    for agent, reward, key in zip(state.agents, method.rewards, _keys(key_update, len(method.rewards)), strict=True):
        # before the updates: what the method knows doesn't change within a round
        valued = batches._replace(reward=value(reward, state.knowledge, batches, config) * config.reward_scale)
        agent, info = jax.lax.scan(update, agent, (valued, sac.draw_noise(key, shape, config)))
        agents.append(agent)
        infos.append(info)
    return tuple(agents), jax.tree.map(lambda *values: jnp.mean(jnp.stack(values)), *infos)


def value(
    reward: Callable[[Any, Transition, Config], Array], knowledge: Any, batches: Transition, config: Config
) -> Array:
    """A method's `reward` of minibatches (n, size), `VALUED_TOGETHER` at a time."""
    return jax.lax.map(lambda batch: reward(knowledge, batch, config), batches, batch_size=VALUED_TOGETHER)


def annealed_temperature(index: Array, config: Config) -> Array:
    """SAC's own temperature in round `index`, in reward units: from `initial_temperature` to `temperature`, geometrically."""
    done = jnp.clip(index / jnp.maximum(config.anneal_share * config.num_rounds, 1.0), 0.0, 1.0)
    first, last = jnp.maximum(config.initial_temperature, 1e-6), jnp.maximum(config.temperature, 1e-6)
    return jnp.exp((1 - done) * jnp.log(first) + done * jnp.log(last))


def faded_learning_rate(index: Array, config: Config) -> Array:
    """SAC's learning rate in round `index`: whole at first, then falling linearly to a tenth at the end.

    Late in a training a full step trades one of two nearly equal ways for the other.
    """
    left = 1 - index / config.num_rounds
    return config.learning_rate * jnp.clip(left / jnp.maximum(config.fade_share, 1e-6), 0.1, 1.0)


def run_round(
    state: TrainingState, index: Array, config: Config, teacher: synthetic_human.Teacher = synthetic_human.SYNTHETIC
) -> tuple[TrainingState, dict[str, Array]]:
    """Round `index` with a teacher that answers inside the program; returns the state and the round's figures."""
    state, queries, collected = collect_and_ask(state, index, config)
    _, _, key_teacher, _, _ = _round_keys(state, index)
    preferences = None if queries is None else teacher.answer(key_teacher, queries, config)
    state, learned = learn_and_improve(state, index, preferences, config)
    return state, collected | learned


def run_rounds(
    state: TrainingState, indices: Array, config: Config, teacher: synthetic_human.Teacher = synthetic_human.SYNTHETIC
) -> tuple[TrainingState, dict[str, Array]]:
    """Rounds `indices` (n,) one after the other: the state after them, and curves (n,)."""
    return jax.lax.scan(lambda state, index: run_round(state, index, config, teacher), state, indices)


def train(config: Config, teacher: synthetic_human.Teacher = synthetic_human.SYNTHETIC) -> Result:
    """A whole training. Pure: works under `jax.jit`, `jax.vmap` (over any traced leaves of `config`) and in a scan.

    Raises:
      ValueError: a setting makes no sense; one line says which, its value, and what would be right.
    """
    check(config)
    state, curves = run_rounds(init(config), jnp.arange(config.num_rounds), config, teacher)
    return finish(state, curves, config)


def finish(state: TrainingState, curves: dict[str, Array], config: Config) -> Result:
    """What remains of a training when its rounds are done."""
    return Result(agents=state.agents, knowledge=state.knowledge, curves=curves, config=config)


def _keys(key: Array, number: int) -> list[Array]:
    """A key for each of `number` agents. The first one's is `key` itself: others don't change its numbers."""
    return [key, *(jax.random.fold_in(key, other) for other in range(1, number))]


def _round_keys(state: TrainingState, index: Array) -> Array:
    """Keys of round `index`: acting, asking, answering, learning, improving. The same from every half."""
    return jax.random.split(jax.random.fold_in(state.key, index), 5)
