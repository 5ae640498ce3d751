"""Collecting: the environments of a training, side by side, one policy acting in all of them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from flax import struct
from jax import Array

from peps_jax import explicability, methods
from peps_jax.config import Config
from peps_jax.explicability import Score
from peps_jax.trajectory import Trajectory, Transition


class Running(NamedTuple):
    """Sums over the episodes that are under way, (num_envs,) each."""

    score: Score
    length: Array


@struct.dataclass
class Actors:
    """Where the environments stand between two rounds."""

    state: Any  # (num_envs, ...)
    observation: Array  # (num_envs, observation_size)
    running: Running


def init(key: Array, config: Config) -> Actors:
    """All environments at their start."""
    environment, params, _ = methods.task(config)
    state, observation = jax.vmap(environment.reset, in_axes=(0, None))(jax.random.split(key, config.num_envs), params)
    zeros = jnp.zeros(config.num_envs)
    return Actors(state=state, observation=observation, running=Running(Score(zeros, zeros, zeros, zeros), zeros))


def collect(
    actors: Actors, act: Callable[[Array, Array, Array], Array], key: Array, config: Config
) -> tuple[Actors, Trajectory, dict[str, Array]]:
    """`rollout_length` steps of every environment; an episode that ends is followed by a new one.

    Args:
      act: (observations (num_envs, ...), key, step within the round) -> actions (num_envs, ...).

    Returns:
      actors: where the environments stand now.
      trajectory: all transitions, each with its own last observation, never the next episode's first.
      info: means over the episodes that ended in this round, and their number, `episodes`; where that is 0 they are 0.
    """
    environment, params, belief = methods.task(config)
    reset = jax.vmap(environment.reset, in_axes=(0, None))
    step = jax.vmap(environment.step, in_axes=(0, 0, 0, None))

    def step_all(carry: tuple[Any, Array], now: tuple[Array, Array]) -> tuple[tuple[Any, Array], Trajectory]:
        state, observation = carry
        time, key = now
        key_act, key_env, key_reset = jax.random.split(key, 3)
        action = act(observation, key_act, time)
        after = step(jax.random.split(key_env, config.num_envs), state, action, params)
        over = after.terminated | after.truncated
        start, first = reset(jax.random.split(key_reset, config.num_envs), params)
        restart = lambda new, old: jax.vmap(jnp.where)(over, new, old)
        transition = Transition(
            observation, action, after.reward, after.observation, after.terminated.astype(jnp.float32)
        )
        row = Trajectory(transition, after.truncated, after.events, state, after.state)
        return (jax.tree.map(restart, start, after.state), restart(first, after.observation)), row

    keys = jax.random.split(key, config.rollout_length)
    times = jnp.arange(config.rollout_length)
    (state, observation), trajectory = jax.lax.scan(step_all, (actors.state, actors.observation), (times, keys))

    score = jax.vmap(jax.vmap(lambda *transition: explicability.score(environment, params, belief, *transition)))
    scores = score(trajectory.state, trajectory.transition.action, trajectory.next_state)
    over = (trajectory.transition.terminated > 0) | trajectory.truncated
    values = Running(scores, jnp.ones_like(scores.return_))
    totals, running = explicability.episode_sums(values, over, actors.running)
    return (
        Actors(state=state, observation=observation, running=running),
        trajectory,
        _episode_means(totals, over, trajectory.events, environment.event_names),
    )


def _episode_means(totals: Running, over: Array, events: Array, names: tuple[str, ...]) -> dict[str, Array]:
    number = jnp.sum(over)
    mean = lambda values: jnp.sum(jnp.where(over, values, 0.0)) / jnp.maximum(number, 1)
    info = {
        "return_": mean(totals.score.return_),
        "explicability": mean(totals.score.explicability),
        "belief_gap": mean(totals.score.belief_gap),
        "human_return": mean(totals.score.human_return),
        "length": mean(totals.length),
        "episodes": number.astype(jnp.float32),
    }
    return info | {name: mean(events[..., i]) for i, name in enumerate(names)}
