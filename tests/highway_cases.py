"""What the tests of the road share: the road, its domains, and what hypothesis draws."""

import jax
import numpy as np
from hypothesis import settings
from hypothesis import strategies as st

import peps_envs
from peps_envs import highway
from peps_envs.highway import vehicle

ROAD = highway.Highway()
reset, step = jax.jit(ROAD.reset), jax.jit(ROAD.step)
TASKS = {name: peps_envs.make(f"highway-{name}") for name in highway.DOMAINS}
GRAVITY = vehicle.GRAVITY

property_of_all = settings(deadline=None, derandomize=True, max_examples=60)
seeds = st.integers(0, 2**31 - 1)
plans = st.lists(st.integers(0, 4), min_size=8, max_size=8).map(np.int32)
