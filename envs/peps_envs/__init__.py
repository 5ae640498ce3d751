"""Environments whose dynamics are data: what is true, and what a human believes, are two values of the same parameters."""

from peps_envs.environment import ActionSpace, Bounds, Box, Discrete, Environment, Judgement, Step
from peps_envs.perception import Gaussian, Mixture, PerceivedDensity
from peps_envs.registry import Task, make, names, register
from peps_envs.scene import Scene

__all__ = [
    "ActionSpace",
    "Bounds",
    "Box",
    "Discrete",
    "Environment",
    "Gaussian",
    "Judgement",
    "Mixture",
    "PerceivedDensity",
    "Scene",
    "Step",
    "Task",
    "make",
    "names",
    "register",
]
