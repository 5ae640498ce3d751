"""What the tests of navigation share: domains and beliefs, positions in them, and compiled functions of one state."""

import jax
import jax.numpy as jnp
import numpy as np
from hypothesis import settings
from hypothesis import strategies as st

import peps_envs
from peps_envs import navigation
from peps_envs.navigation import Navigation, NavigationState

NAVIGATION = Navigation()
TASKS = {name: peps_envs.make(f"nav-{name}") for name in navigation.DOMAINS}
MINDS = {(name, "truth"): task.params for name, task in TASKS.items()} | {
    (name, belief): params for name, task in TASKS.items() for belief, params in task.beliefs.items()
}
BLOCK = (1.5, 1.5, 4.5, 4.5)
EVERYWHERE = (0.0, 0.0, 6.0, 6.0)
SLACK = 2e-4  # arena units: how far rounding may carry a position across a face

property_of_all = settings(deadline=None, derandomize=True, max_examples=80)
minds = st.sampled_from(list(MINDS.values()))
# the faces of block, grounds and arena are where mistakes hide
coordinates = st.sampled_from([0.0, 0.75, 1.5, 4.5, 5.0, 6.0]) | st.floats(0, 6, width=32)
actions = st.tuples(st.floats(-1.5, 1.5, width=32), st.floats(-1.5, 1.5, width=32)).map(np.float32)
seeds = st.integers(0, 2**31 - 1)


@st.composite
def positions(draw, of=minds):
    """Parameters and a position that they allow."""
    params = draw(of)
    x, y = draw(coordinates), draw(coordinates)
    left, top, right, bottom = np.asarray(params.walls)[0]
    if left < x < right and top < y < bottom:
        x = left if x < 3 else right
    return params, np.float32([x, y])


def at(position, time=0, dtype=jnp.float32) -> NavigationState:
    return NavigationState(jnp.asarray(position, dtype), jnp.asarray(time, jnp.int32))


@jax.jit
def distribution(position, action, params):
    return NAVIGATION.next_state_distribution(at(position), action, params)


@jax.jit
def relative_log_prob(position, action, perceived, params):
    return NAVIGATION.next_state_distribution(at(position), action, params).relative_log_prob(perceived)


@jax.jit
def relative_entropy(position, action, params):
    return NAVIGATION.next_state_distribution(at(position), action, params).relative_entropy()


@jax.jit
def step(seed, state, action, params):
    return NAVIGATION.step(jax.random.key(seed), state, action, params)
