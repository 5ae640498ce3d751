"""What happened: transitions as the agent saw them, and trajectories with the environment's states."""

from __future__ import annotations

from typing import Any, NamedTuple

from jax import Array


class Transition(NamedTuple):
    """What the agent saw of a step. r_A only: surrogate reward and entropies are applied when it is sampled."""

    observation: Array  # (..., observation_size)
    action: Array  # (..., action_size), or (...) of integers for discrete actions
    reward: Array  # (...) r_A
    next_observation: Array  # (..., observation_size), of the last step too, not of the next episode's start
    movement: Array  # (..., perceived_size) of the perceived state in the step, in units of sigma_p: what T_A predicts
    terminated: Array  # (...) bool: the MDP ended; False where only time ran out
    # what nobody knows but the yardsticks, the oracle and DARC; None where the human doesn't watch every environment
    human_reward: Array | None  # (...) r_H
    log_belief: Array | None  # (...) l_H
    imagined: Array | None = (
        None  # (..., perceived_size) the movement that the human imagines, where a method learns from it
    )


class Trajectory(NamedTuple):
    """What a round collected: (steps, num_envs, ...). The environment's states are what a teacher is shown, not the agent."""

    transition: Transition
    truncated: Array  # (steps, num_envs) bool
    events: Array  # (steps, num_envs, len(event_names)) bool
    worth: Array  # (steps, watched_envs, 2) what a synthetic human with the belief, and one who knows the truth, think of a step
    state: Any
    next_state: Any
