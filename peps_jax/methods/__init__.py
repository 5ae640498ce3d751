"""The methods by name."""

from typing import Any

import peps_envs
from peps_envs.registry import unknown_name
from peps_jax.config import Config
from peps_jax.methods.drlhp import DRLHP, DRLHP_UNSCALED
from peps_jax.methods.human_expectation import HUMAN_EXPECTATION
from peps_jax.methods.method import Method
from peps_jax.methods.peps import PEPS, PEPS_ABSOLUTE
from peps_jax.methods.policy_shaping import POLICY_SHAPING
from peps_jax.methods.sac import SAC

METHODS = {
    method.name: method
    for method in (PEPS, SAC, DRLHP, POLICY_SHAPING, HUMAN_EXPECTATION, DRLHP_UNSCALED, PEPS_ABSOLUTE)
}


def get(name: str) -> Method:
    """The method called `name`.

    Raises:
      ValueError: no such method; the message says the nearest.
    """
    if name not in METHODS:
        raise ValueError(unknown_name("method", name, METHODS))
    return METHODS[name]


def task(config: Config) -> tuple[peps_envs.Environment, Any, Any]:
    """The environment, the parameters of the world that the method acts in, and the human's belief."""
    environment, params, belief = config.task()
    return environment, get(config.method).world(params, belief), belief


__all__ = ["METHODS", "Method", "get", "task"]
