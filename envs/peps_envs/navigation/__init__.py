"""Continuous navigation: a point on its way to a goal, over ice and sand and past a pit, and the paper's domains D1 to D4."""

from peps_envs.navigation.density import NavigationDensity
from peps_envs.navigation.domains import DOMAINS, DYNAMICS_BIAS, REWARD_BIAS, domain
from peps_envs.navigation.environment import Navigation, NavigationState
from peps_envs.navigation.geometry import distance, free_interval, inside, walk
from peps_envs.navigation.parameters import NOWHERE, NavigationParams, make_params

__all__ = [
    "DOMAINS",
    "DYNAMICS_BIAS",
    "NOWHERE",
    "REWARD_BIAS",
    "Navigation",
    "NavigationDensity",
    "NavigationParams",
    "NavigationState",
    "distance",
    "domain",
    "free_interval",
    "inside",
    "make_params",
    "walk",
]
