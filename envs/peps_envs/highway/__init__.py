"""highway-env in pure JAX, with a road that may be wet, and the paper's driving scenario on it (Sec. 5.2)."""

from peps_envs.highway.environment import ClassicHighway, Highway, HighwayParams, HighwayState
from peps_envs.highway.presets import DOMAINS, domain, make_params
from peps_envs.highway.replay import replay

__all__ = ["DOMAINS", "ClassicHighway", "Highway", "HighwayParams", "HighwayState", "domain", "make_params", "replay"]
