"""Pure-JAX worlds whose dynamics are data: what is true, and what a human believes, are two values of the same parameters."""

from peps_envs.environment import ActionSpace, Box, Discrete, Environment, NextState, Step
from peps_envs.registry import Task, make, names, register

__all__ = ["ActionSpace", "Box", "Discrete", "Environment", "NextState", "Step", "Task", "make", "names", "register"]
