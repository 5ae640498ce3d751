"""The methods by name, in the order in which they are listed."""

# isort: off
from peps_jax.methods.peps import PEPS as PEPS
from peps_jax.methods.sac import SAC as SAC
from peps_jax.methods.drlhp import DRLHP as DRLHP
from peps_jax.methods.policy_shaping import POLICY_SHAPING as POLICY_SHAPING
from peps_jax.methods.oracle import ORACLE as ORACLE
from peps_jax.methods.darc import DARC as DARC
from peps_jax.methods.human_expectation import HUMAN_EXPECTATION as HUMAN_EXPECTATION
# isort: on

from peps_jax.methods.method import METHODS, Method, get, register

__all__ = ["METHODS", "Method", "get", "register"]
