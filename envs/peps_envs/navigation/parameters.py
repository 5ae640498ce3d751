"""The numbers of a navigation domain, or of a belief about one."""

from __future__ import annotations

import jax.numpy as jnp
from flax import struct
from jax import Array

NOWHERE = (-9.0, -9.0, -9.0, -9.0)  # an area that no position is in


@struct.dataclass
class NavigationParams:
    """A domain, or a belief about one. Areas are (x0, y0, x1, y1), closed, in arena units."""

    size: Array  # (2,) width and height of the arena
    start: Array  # (2,)
    goal: Array  # (4,) area
    pit: Array  # (4,) area
    walls: Array  # (n, 4) areas that nothing enters
    ice: Array  # (4,) area
    sand: Array  # (4,) area
    step_length: Array  # arena units a step
    full_action: Array  # norm of the action from which on a step has its full length
    ice_gain: Array  # share of a step that is made on ice
    sand_gain: Array  # share of a step that is made on sand
    sand_stuck: Array  # probability of not moving at all on sand
    ice_noise: Array  # standard deviation of the displacement on ice, arena units
    pit_noise: Array  # the same at the pit's edge
    pit_range: Array  # distance over which the pit's noise fades, arena units
    perception_width: Array  # sigma_p, arena units
    goal_reward: Array  # on reaching the goal, which ends the episode
    pit_reward: Array  # on falling into the pit, which ends the episode
    step_reward: Array  # every step
    progress_reward: Array  # per arena unit that the distance to the goal area shrinks


def make_params(**changes) -> NavigationParams:
    """A 6 x 6 arena without pit, walls, ice or sand, the goal in the upper right corner; `changes` replace fields.

    Raises:
      ValueError: a field that `NavigationParams` doesn't have.
    """
    fields = dict(
        size=(6.0, 6.0), start=(0.5, 0.5), goal=(5.0, 0.0, 6.0, 1.0), pit=NOWHERE, walls=(NOWHERE,), ice=NOWHERE, sand=NOWHERE,
        step_length=0.75, full_action=0.85, ice_gain=1.0, sand_gain=1.0, sand_stuck=0.0, ice_noise=0.0, pit_noise=0.0,
        pit_range=0.6, perception_width=0.2, goal_reward=100.0, pit_reward=-100.0, step_reward=-1.0, progress_reward=1.0,
    )  # fmt: skip
    unknown = sorted(set(changes) - set(fields))
    if unknown:
        raise ValueError(f"navigation parameter {unknown[0]!r}: known are {', '.join(fields)}")
    return NavigationParams(
        **{name: jnp.asarray(value, jnp.result_type(float)) for name, value in (fields | changes).items()}
    )
