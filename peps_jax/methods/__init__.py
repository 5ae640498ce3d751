"""The methods by name."""

from peps_envs.registry import unknown_name
from peps_jax.methods.drlhp import DRLHP
from peps_jax.methods.human_expectation import HUMAN_EXPECTATION
from peps_jax.methods.method import Method
from peps_jax.methods.peps import PEPS
from peps_jax.methods.policy_shaping import POLICY_SHAPING
from peps_jax.methods.sac import SAC

METHODS = {method.name: method for method in (PEPS, SAC, DRLHP, POLICY_SHAPING, HUMAN_EXPECTATION)}


def get(name: str) -> Method:
    """The method called `name`.

    Raises:
      ValueError: no such method; the message says the nearest.
    """
    if name not in METHODS:
        raise ValueError(unknown_name("method", name, METHODS))
    return METHODS[name]


__all__ = ["METHODS", "Method", "get"]
