"""The data that parts hand to one another: what happened, pieces of it, and what a teacher says of them."""

from __future__ import annotations

from typing import Any, NamedTuple

from jax import Array


class Transition(NamedTuple):
    """What the agent saw of a step. r_A only: surrogate reward and entropies are applied when it is sampled."""

    observation: Array  # (..., observation_size)
    action: Array  # (..., action_size), or (...) of integers for discrete actions
    reward: Array  # (...) r_A
    next_observation: Array  # (..., observation_size), of the last step too, not of the next episode's start
    terminated: Array  # (...) 1.0 where the MDP ended; 0.0 where only time ran out


class Trajectory(NamedTuple):
    """What a round collected: (steps, num_envs, ...). The world's states are what a teacher is shown, not the agent."""

    transition: Transition
    truncated: Array  # (steps, num_envs) bool
    events: Array  # (steps, num_envs, len(event_names)) bool
    state: Any
    next_state: Any


class Segments(NamedTuple):
    """Pieces of trajectories, padded to one length. Two along the axis before `steps` make a query."""

    observation: Array  # (..., steps, observation_size)
    action: Array  # (..., steps, action_size) or (..., steps)
    mask: Array  # (..., steps) 1.0 where the segment goes on, 0.0 after its end
    state: Any  # (..., steps, ...) the world's state before each step: what a person is shown
    next_state: Any  # (..., steps, ...) and after it


class Preferences(NamedTuple):
    """Queries with their answers."""

    segments: Segments  # (queries, 2, steps, ...)
    answers: Array  # (queries,) P(first preferred): 1, 0, or 1/2 for a tie
    answered: Array  # (queries,) 1.0, or 0.0 where the teacher skipped
