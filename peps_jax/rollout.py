"""Collecting: the environments of a training, side by side, one policy acting in all of them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import chex
import jax
import jax.numpy as jnp
from flax import struct
from jax import Array

import peps_envs
from peps_jax import explicability
from peps_jax.config import Problem
from peps_jax.explicability import Score
from peps_jax.settings import RolloutSettings
from peps_jax.trajectory import Trajectory, Transition


class Running(NamedTuple):
    """Sums over the episodes that are under way, (watched_envs,) each."""

    score: Score
    length: Array


@struct.dataclass
class Actors:
    """Where the environments stand between two rounds."""

    state: Any  # (num_envs, ...)
    observation: Array  # (num_envs, observation_size)
    running: Running


def init(key: Array, problem: Problem, settings: RolloutSettings) -> Actors:
    """All environments at their start."""
    reset = jax.vmap(problem.environment.reset, in_axes=(0, None))
    state, observation = reset(jax.random.split(key, settings.num_envs), problem.params)
    zeros = jnp.zeros(settings.watched_envs, jnp.float32)
    return Actors(state, _seen(observation), Running(Score(zeros, zeros, zeros, zeros), zeros))


def exploring(
    behave: Callable[[Array, Array], Array],
    space: peps_envs.ActionSpace,
    only: Array,
    key: Array,
    settings: RolloutSettings,
) -> Callable[[Array, Array, Array], Array]:
    """What `collect` acts by: `behave`, but for a share `exploration` of random actions; all are random where `only` holds.

    A random action is held for `hold_steps`: a walk that turns at every step hardly leaves the start. Some are taken to the very
    end: what the policy has abandoned would otherwise never be seen, asked about and valued again.

    Args:
      behave: (observations (num_envs, ...), key) -> actions (num_envs, ...).
    """

    def act(observation: Array, key_act: Array, time: Array) -> Array:
        action = behave(observation, key_act)
        key_uniform, key_explore = jax.random.split(jax.random.fold_in(key, time // settings.hold_steps))
        uniform = jax.vmap(lambda key: random_action(space, key))(jax.random.split(key_uniform, settings.num_envs))
        chance = jax.random.uniform(key_explore, (settings.num_envs,), jnp.float32)
        return jax.vmap(jnp.where)((chance < settings.exploration) | only, uniform, action)

    return act


def random_action(space: peps_envs.ActionSpace, key: Array) -> Array:
    """A uniformly random action."""
    if isinstance(space, peps_envs.Discrete):
        return jax.random.randint(key, (), 0, space.size, jnp.int32)
    return jax.random.uniform(key, (space.size,), jnp.float32, minval=-1.0, maxval=1.0)


def collect(
    actors: Actors,
    act: Callable[[Array, Array, Array], Array],
    key: Array,
    problem: Problem,
    settings: RolloutSettings,
) -> tuple[Actors, Trajectory, dict[str, Array]]:
    """`settings.length` steps of every environment; an episode that ends is followed by a new one.

    Args:
      act: (observations (num_envs, ...), key, step within the round) -> actions (num_envs, ...).

    Returns:
      actors: where the environments stand now.
      trajectory: all transitions, each with its own last observation, never the next episode's first.
      info: means over the watched episodes that ended in this round, and their number, `episodes`; where that is 0 they are 0.
    """
    environment, params = problem.environment, problem.params
    reset = jax.vmap(environment.reset, in_axes=(0, None))
    told = settings.watched_envs == settings.num_envs
    split = lambda key: jax.random.split(key, settings.num_envs)

    def step_all(
        carry: tuple[Any, Array], now: tuple[Array, Array]
    ) -> tuple[tuple[Any, Array], tuple[Trajectory, Score]]:
        state, observation = carry
        time, key = now
        key_act, key_env, key_reset = jax.random.split(key, 3)
        action = act(observation, key_act, time)
        chex.assert_axis_dimension(action, 0, settings.num_envs)
        after, score, imagined = explicability.judged_steps(
            problem, split(key_env), state, action, settings.watched_envs
        )
        seen, over = _seen(after.observation), after.terminated | after.truncated
        start, first = reset(split(key_reset), params)
        restart = lambda new, old: jax.vmap(jnp.where)(over, new, old)
        moved = jax.vmap(movement, in_axes=(0, 0, None))(state, after.state, problem)
        move_in_mind = jax.vmap(movement_to, in_axes=(0, 0, None))
        transition = Transition(
            observation=observation,
            action=action,
            reward=after.reward,
            next_observation=seen,
            movement=moved,
            terminated=after.terminated,
            human_reward=score.human_return if told else None,
            log_belief=score.log_belief if told else None,
            imagined=move_in_mind(state, imagined, problem) if settings.imagines else None,
        )
        row = Trajectory(transition, after.truncated, after.events, score.worth, state, after.state)
        return (jax.tree.map(restart, start, after.state), restart(_seen(first), seen)), (row, score)

    times = jnp.arange(settings.length, dtype=jnp.int32)
    keys = jax.random.split(key, settings.length)
    (state, observation), (trajectory, scores) = jax.lax.scan(
        step_all, (actors.state, actors.observation), (times, keys)
    )
    watched = lambda rows: rows[:, : settings.watched_envs]
    over = watched(trajectory.transition.terminated | trajectory.truncated)
    values = Running(scores, jnp.ones_like(scores.return_))
    totals, running = explicability.episode_sums(values, over, actors.running)
    return (
        Actors(state=state, observation=observation, running=running),
        trajectory,
        _episode_means(totals, over, watched(trajectory.events), environment.event_names),
    )


def movement(state: Any, next_state: Any, problem: Problem) -> Array:
    """How the perceived state moves in a step, in units of sigma_p, (perceived_size,): what T_A predicts."""
    return movement_to(state, problem.environment.perceive(next_state), problem)


def movement_to(state: Any, perceived: Array, problem: Problem) -> Array:
    """The same, to a next state as it is perceived."""
    width = problem.environment.perception_width(problem.params)
    return ((perceived - problem.environment.perceive(state)) / width).astype(jnp.float32)


def _seen(observation: Array) -> Array:
    """What the agent is given: 32-bit floats, whatever the environment computes with."""
    return observation.astype(jnp.float32)


def _episode_means(totals: Running, over: Array, events: Array, names: tuple[str, ...]) -> dict[str, Array]:
    number = jnp.sum(over, dtype=jnp.float32)
    mean = lambda values: jnp.sum(jnp.where(over, values, 0.0), dtype=jnp.float32) / jnp.maximum(number, 1)
    info = {
        "return_": mean(totals.score.return_),
        "explicability": mean(totals.score.explicability),
        "belief_gap": mean(totals.score.belief_gap),
        "human_return": mean(totals.score.human_return),
        "length": mean(totals.length),
        "episodes": number,
    }
    return info | {name: mean(events[..., i]) for i, name in enumerate(names)}
