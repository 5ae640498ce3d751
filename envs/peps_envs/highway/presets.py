"""The driving domains, dry and wet, and what a human may believe about them."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from peps_envs.highway.environment import HighwayParams, Ratings, Scenario
from peps_envs.highway.simulation import highway_env
from peps_envs.highway.vehicle import Friction, Gains

# Friction of dry asphalt is 0.7-0.8, of wet asphalt 0.4-0.5. The gains are those that don't overshoot where friction limits.
DRY = dict(friction_mean=0.75, friction_sd=0.05)
DOMAINS = {"dry": DRY, "rain": dict(friction_mean=0.40, friction_sd=0.10)}

# What the human minds besides, in the presets with a biased reward: lane changes, the more the faster they are. The paper's
# participants preferred braking to steering on a dry road; by the ratings alone the best is to steer, for who brakes in the
# lane stands in the end, near the other car. With these costs braking in the lane is the human's best by 0.8, a lane change at
# 17 m/s comes before one at 25 m/s by more than 2, and the latter weighs as much as a crash with a probability of 0.5.
REWARD_BIAS = dict(lane_change_cost=1.0, swerve_cost=6.0)

# What people tell apart: about 10 % of a distance or a speed, of 25 m and 25 m/s; and 0.3 m beside a line on the road.
PERCEPTION_WIDTH = (2.5, 0.3, 2.5)

_DEFAULTS = dict(
    friction_mean=np.inf, friction_sd=0.0, engine=6.0, speed_gain=1 / 0.6, heading_gain=2.5, lateral_gain=0.8,
    target_speeds=np.arange(0.0, 31.0, 5.0), start_speed=(25.0, 25.0), gap=(20.0, 26.0), deceleration=(5.0, 6.0),
    onset=(0.8, 1.0), spacing=(25.0, 45.0), rating_speed=3.42, rating_distance=4.57, rating_relative_speed=3.28,
    rating_lane=3.78, crash_reward=-10.0, lane_change_cost=0.0, swerve_cost=0.0, full_speed=30.0, far=50.0,
    perception_width=PERCEPTION_WIDTH,
)  # fmt: skip


def make_params(**changes) -> HighwayParams:
    """A road without friction limit and the paper's scenario on it; `changes` replace numbers.

    Raises:
      ValueError: a number that the parameters don't have.
    """
    unknown = sorted(set(changes) - set(_DEFAULTS))
    if unknown:
        raise ValueError(f"highway parameter {unknown[0]!r}: known are {', '.join(_DEFAULTS)}")
    value = _DEFAULTS | changes
    params = HighwayParams(
        physics=highway_env(value["target_speeds"]).replace(
            friction=Friction(mean=value["friction_mean"], sd=value["friction_sd"], engine=value["engine"]),
            gains=Gains(speed=value["speed_gain"], heading=value["heading_gain"], lateral=value["lateral_gain"]),
        ),
        scenario=Scenario(
            speed=value["start_speed"], gap=value["gap"], deceleration=value["deceleration"], onset=value["onset"],
            spacing=value["spacing"],
        ),
        ratings=Ratings(
            speed=value["rating_speed"], distance=value["rating_distance"],
            relative_speed=value["rating_relative_speed"], lane=value["rating_lane"],
        ),
        crash_reward=value["crash_reward"],
        lane_change_cost=value["lane_change_cost"],
        swerve_cost=value["swerve_cost"],
        full_speed=value["full_speed"],
        far=value["far"],
        perception_width=value["perception_width"],
    )  # fmt: skip
    is_leaf = lambda node: isinstance(node, tuple)
    return jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.result_type(float)), params, is_leaf=is_leaf)


def domain(name: str) -> tuple[HighwayParams, dict[str, HighwayParams]]:
    """The true parameters of domain "dry" or "rain", and the beliefs about it by their names.

    `biased` thinks that tyres grip as on a dry road, `unbiased` believes the truth, `reward` minds lane changes in the true
    dynamics, and `both` has both biases.
    """
    truth = DOMAINS[name]
    beliefs = {"biased": DRY, "unbiased": {}, "reward": REWARD_BIAS, "both": DRY | REWARD_BIAS}
    return make_params(**truth), {belief: make_params(**(truth | bias)) for belief, bias in beliefs.items()}
