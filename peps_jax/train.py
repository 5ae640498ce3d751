"""A training: the paper's Algorithm 1 as one pure function of a `Config`.

`train` scans over rounds. A round has two halves with the teacher between them: `collect_and_ask` ends with queries,
`learn_and_improve` begins when their answers are filed. A host loop may run rounds one by one (`run_round`), or the halves with
a person in between (a host teacher), and gets the same numbers as the scan.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array

from peps_jax import generator, methods, rollout
from peps_jax.config import Config, Problem, capacity
from peps_jax.learning import replay, sac, team
from peps_jax.learning.surrogate import SurrogateState
from peps_jax.methods import Method
from peps_jax.preferences import data
from peps_jax.preferences.data import Answers, PreferenceSet, Queries
from peps_jax.preferences.teachers import SYNTHETIC, Teacher
from peps_jax.round import Round, round_at
from peps_jax.settings import AgentSettings, ScheduleSettings, Settings, settings_of
from peps_jax.trajectory import Transition

# Minibatches whose rewards are computed at once, where they are computed one by one. All of a round's took two to three times as
# long on a CPU: what the ensembles' layers put out didn't stay in the cache.
VALUED_TOGETHER = 5


@struct.dataclass
class Training:
    """What rounds are run with: everything that a `Config` names, resolved once."""

    config: Config
    method: Method = struct.field(pytree_node=False)
    problem: Problem  # that the method acts in
    settings: Settings
    answer: Callable[..., Answers] = struct.field(pytree_node=False)  # who answers a round's queries inside the program


@struct.dataclass
class TrainingState:
    """All of a training between two rounds, random key included."""

    agents: tuple[sac.Agent, ...]  # one for each of the method's rewards; they act together
    knowledge: Any  # what the method learns beside the policies
    preferences: PreferenceSet | None  # None of a method that uses none
    budget: (
        Array | None
    )  # () int32, queries that are asked in all; a value, so that a recording teaches by the same program
    replay: Transition
    actors: rollout.Actors
    key: Array


@struct.dataclass
class Result:
    """A finished training, ready to act."""

    training: Training
    agents: tuple[sac.Agent, ...]
    knowledge: Any
    preferences: PreferenceSet | None  # that r-hat was fitted to
    curves: dict[str, Array]  # (rounds,) each

    @property
    def config(self) -> Config:
        """What was asked for."""
        return self.training.config

    @property
    def surrogate(self) -> SurrogateState | None:
        """r-hat; None of a method that learns none."""
        return self.training.method.surrogate(self.knowledge)

    def act(self, observation: Array, key: Array | None = None) -> Array:
        """The action for one observation: the policy's mode, or a sample if a key is given."""
        return self.policy()(observation, key)[0]

    def policy(self) -> Callable[[Array, Array | None], tuple[Array, Array]]:
        """(observation, key or None) -> the action and l_pi, log pi(a|s) relative to the uniform policy."""

        return policy_of(self.agents, self.training.settings.agent)


def policy_of(
    agents: tuple[sac.Agent, ...], settings: AgentSettings
) -> Callable[[Array, Array | None], tuple[Array, Array]]:
    """As `Result.policy`, of `agents` that act together."""

    def policy(observation: Array, key: Array | None) -> tuple[Array, Array]:
        observation = jnp.asarray(observation, jnp.float32)
        return team.mode(agents, observation, settings) if key is None else team.act(agents, observation, key, settings)

    return policy


def check(config: Config) -> None:
    """Raises ValueError, in one line, for the first setting that makes no sense."""
    methods.get(config.method)
    config.check()


def prepare(config: Config, teacher: Teacher = SYNTHETIC) -> Training:
    """Resolves what `config` names: the method, the problem, and every part's settings."""
    method = methods.get(config.method)
    problem = method.acts_in(config.problem())
    settings = method.settings(settings_of(config, problem))
    return Training(config, method, problem, settings, teacher.answer)


def init(training: Training, teacher: Teacher = SYNTHETIC) -> TrainingState:
    """The state before the first round, with what the teacher has said before."""
    state, settings = _untaught(training), training.settings
    if not training.method.asks:
        return state
    spaces = settings.agent.observation_size, settings.agent.action_space
    room = data.empty(settings.queries.room, settings.queries.segment_length, *spaces)
    return state.replace(
        preferences=data.before(teacher.recorded, room, teacher.asks),
        budget=jnp.asarray(settings.queries.budget if teacher.asks else 0),
    )


@jax.jit  # one program instead of hundreds of operations, where the caller doesn't compile
def _untaught(training: Training) -> TrainingState:
    settings, method = training.settings, training.method
    key_agent, key_knowledge, key_actors, key = jax.random.split(generator.key(training.config.seed), 4)
    spaces = settings.agent.observation_size, settings.agent.action_space
    return TrainingState(
        agents=tuple(sac.init(key, settings.agent) for key in sac.agent_keys(key_agent, len(method.rewards))),
        knowledge=method.init(key_knowledge, settings),
        preferences=None,
        budget=None,
        replay=replay.init(
            settings.schedule.room * settings.schedule.steps_per_round,
            *spaces,
            settings.dynamics.perceived_size,
            told=settings.rollout.watched_envs == settings.rollout.num_envs,
            imagines=settings.rollout.imagines,
        ),
        actors=rollout.init(key_actors, training.problem, settings.rollout),
        key=key,
    )


# --- a round --------------------------------------------------------------------------------------------------------------


def collect_and_ask(
    state: TrainingState, now: Round, training: Training
) -> tuple[TrainingState, Queries | None, dict[str, Array]]:
    """The first half of a round: act, remember, and choose what to ask. Queries are None of a method that asks nothing."""
    settings, method = training.settings, training.method
    key_act, key_hold, _ = now.keys.act
    agent = settings.agent.replace(temperature=now.temperature)
    behave = lambda observation, key: method.behave(state.agents, observation, key, agent)
    act = rollout.exploring(behave, settings.agent.action_space, now.explores_only, key_hold, settings.rollout)
    actors, trajectory, info = rollout.collect(state.actors, act, key_act, training.problem, settings.rollout)
    flat = jax.tree.map(lambda rows: rows.reshape(-1, *rows.shape[2:]), trajectory.transition)
    state = state.replace(actors=actors, replay=replay.add(state.replay, flat, now.position))
    if not method.asks:
        return state, None, info
    segments = method.ask(state.knowledge, trajectory, now, settings)
    unasked, room = settings.queries.unasked_rounds, settings.queries.room
    preferences, queries = data.ask(state.preferences, segments, now.index, unasked, room, state.budget)
    return state.replace(preferences=preferences), queries, info


def hear(state: TrainingState, answers: Answers, now: Round) -> TrainingState:
    """Files what a teacher said."""
    return state.replace(preferences=data.file(state.preferences, answers, now.index))


def learn_and_improve(state: TrainingState, now: Round, training: Training) -> tuple[TrainingState, dict[str, Array]]:
    """The second half of a round: learn from replay and from what was answered so far, then improve the policy."""
    preferences = None if state.preferences is None else data.known(state.preferences, now.index)
    learn = training.method.learn
    knowledge, learned = learn(state.knowledge, state.replay, preferences, now, training.settings)
    state = state.replace(knowledge=knowledge)
    agents, improved = improve(state, now, training)
    return state.replace(agents=agents), learned | improved


def improve(state: TrainingState, now: Round, training: Training) -> tuple[tuple[sac.Agent, ...], dict[str, Array]]:
    """SAC updates of one round: every agent sees the same minibatches, with its own reward by what the method knows now."""
    method, settings = training.method, training.settings
    key_batch, key_update, _ = now.keys.improve
    shape = (settings.agent.updates, settings.agent.batch_size)
    index = replay.draw(key_batch, shape, now.filled)
    batches = replay.rows(state.replay, index)
    paid = now.policy_entropy * method.entropy_weight(settings)
    temperature = (now.temperature + paid) * settings.agent.reward_scale
    current = settings.agent.replace(learning_rate=now.learning_rate)
    keys = sac.agent_keys(key_update, len(method.rewards))

    def scaled(reward: Callable[[Any, Transition, Settings], Array]) -> Array:
        of_rows = lambda rows: reward(state.knowledge, rows, settings)
        return values(of_rows, state.replay, index, now, settings) * settings.agent.reward_scale

    steps = team.Step(
        batch=batches,
        # before the updates: what the method knows doesn't change within a round
        rewards=tuple(map(scaled, method.rewards)),
        noises=tuple(sac.draw_noise(key, shape, settings.agent) for key in keys),
        key=jax.random.split(jax.random.fold_in(key_update, settings.agent.updates), settings.agent.updates),
    )
    agents, infos = jax.lax.scan(
        lambda agents, step: team.update(agents, step, temperature, current), state.agents, steps
    )
    return agents, jax.tree.map(jnp.mean, infos)


def values(
    reward: Callable[[Transition], Array], buffer: Transition, index: Array, now: Round, settings: Settings
) -> Array:
    """`reward` of rows `index` (updates, batch_size) of replay, by way of whichever is less: those rows, or all that are filled."""
    schedule = settings.schedule
    # a training of this length in a program with more room goes the same way
    if capacity(schedule.room) * schedule.steps_per_round <= 2 * index.size:
        return relabelled(reward, buffer, now, schedule)[index]
    return values_of_minibatches(reward, buffer, index)


def values_of_minibatches(reward: Callable[[Transition], Array], buffer: Transition, index: Array) -> Array:
    """`reward` of rows `index` (updates, batch_size) of replay, `VALUED_TOGETHER` minibatches at a time."""
    return jax.lax.map(reward, replay.rows(buffer, index), batch_size=VALUED_TOGETHER)


def relabelled(
    reward: Callable[[Transition], Array], buffer: Transition, now: Round, schedule: ScheduleSettings
) -> Array:
    """`reward` of all transitions so far, (room * steps_per_round,), a round's after the other; 0 behind them."""
    steps = schedule.steps_per_round

    def of_round(index: Array, values: Array) -> Array:
        rows = jax.tree.map(lambda rows: jax.lax.dynamic_slice_in_dim(rows, index * steps, steps), buffer)
        return jax.lax.dynamic_update_slice_in_dim(values, reward(rows), index * steps, 0)

    return jax.lax.fori_loop(0, now.index + 1, of_round, jnp.zeros(schedule.room * steps, jnp.float32))


def run_round(state: TrainingState, index: Array, training: Training) -> tuple[TrainingState, dict[str, Array]]:
    """Round `index`, with a teacher that answers inside the program; returns the state and the round's figures."""
    now = round_at(index, state.key, training.settings.schedule)
    state, queries, collected = collect_and_ask(state, now, training)
    if queries is not None:
        answers = training.answer(now.keys.answer, queries, training.problem, training.settings.human)
        state = hear(state, answers, now)
    state, learned = learn_and_improve(state, now, training)
    return state, collected | learned


def run_rounds(state: TrainingState, indices: Array, training: Training) -> tuple[TrainingState, dict[str, Array]]:
    """Rounds `indices` (n,) one after the other: the state after them, and curves (n,)."""
    return jax.lax.scan(lambda state, index: run_round(state, index, training), state, indices)


# --- the whole ------------------------------------------------------------------------------------------------------------


def train(config: Config, teacher: Teacher = SYNTHETIC) -> Result:
    """A whole training.

    Pure: works under `jax.jit`, `jax.vmap` (over any traced leaves of `config`) and in a scan, unless the teacher is outside
    the program (`teachers.host`).

    Raises:
      ValueError: a setting makes no sense, or recorded preferences don't fit; one line says which, and what would be right.
    """
    check(config)
    training = prepare(config, teacher)
    teacher.check(training.method.asks, training.settings, config.num_rounds)
    state = init(training, teacher)
    if teacher.host is not None:
        return finish(*run_with_host(state, training, teacher.host), training)
    indices = jnp.arange(config.num_rounds, dtype=jnp.int32)
    return finish(*_run_rounds(state, indices, training), training)


def finish(state: TrainingState, curves: dict[str, Array], training: Training) -> Result:
    """What remains of a training when its rounds are done."""
    return Result(training, state.agents, state.knowledge, state.preferences, curves)


# compiled once for every structure, whoever teaches, where the caller doesn't compile: so a recording has its teacher's bits
_run_rounds = jax.jit(run_rounds)
halves = jax.jit(collect_and_ask), jax.jit(hear), jax.jit(learn_and_improve)


def run_with_host(
    state: TrainingState,
    training: Training,
    host: Callable[[Queries, int], Answers | None],
    after: Callable[[Result, int], None] | None = None,
) -> tuple[TrainingState, dict[str, Array]]:
    """All rounds, with `host` called between the halves of each, and `after` at its end with what was learned so far."""
    if any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves((state, training))):
        raise ValueError("teacher is outside the program: train can't be inside jax.jit, jax.vmap or a scan then")
    first_half, file, second_half = halves
    rows = []
    for index in range(training.config.num_rounds):
        now = round_at(jnp.asarray(index, jnp.int32), state.key, training.settings.schedule)
        state, queries, collected = first_half(state, now, training)
        said = None if queries is None else host(jax.device_get(queries), index)
        if said is not None:
            answers = data.checked(said, training.settings.queries.per_round)
            state = file(state, answers, now)
        state, learned = second_half(state, now, training)
        rows.append(jax.device_get(collected | learned))
        if after is not None:
            after(finish(state, _curves(rows), training), index)
    return state, jax.tree.map(jnp.asarray, _curves(rows))


def _curves(rows: Sequence[dict[str, np.ndarray]]) -> dict[str, np.ndarray]:
    return jax.tree.map(lambda *values: np.stack(values), *rows)
