"""Strict by default: warnings are errors (pyproject.toml), arrays of different ranks don't mix, two devices on a CPU.

`Line` and `Probe` are environments with closed forms, small enough to compile in a moment.
"""

import os

from compiler import QUICKLY, keep_what_is_compiled

# before JAX starts
os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count=2 {QUICKLY}"
os.environ.setdefault("JAX_PLATFORMS", "cpu")
os.environ["PEPS_JAX_CACHE"] = ""  # tests change code, of which what is kept knows nothing

import dataclasses
import functools
import gc
from typing import NamedTuple

import distrax
import jax
import jax.numpy as jnp
import pytest
from flax import struct
from jax import Array
from sweeps import compiling_into

import peps_jax
from peps_envs import ActionSpace, Box, Discrete, Environment, Gaussian, Step
from peps_jax import Config
from peps_jax.execution.program import FinishedRun
from peps_jax.settings import Settings
from peps_jax.train import init, prepare

jax.config.update("jax_numpy_rank_promotion", "raise")
keep_what_is_compiled()

gc.set_threshold(100_000, 20, 50)  # tracing makes many objects, and hardly any garbage that refers to itself


def pytest_collection_finish() -> None:
    """What was imported stays: the garbage collector doesn't look through it again and again."""
    gc.freeze()


def _lenient(function):
    """`function` with rank promotion allowed inside: distrax mixes ranks when it samples."""

    @functools.wraps(function)
    def call(*args, **kwargs):
        with jax.numpy_rank_promotion("allow"):
            return function(*args, **kwargs)

    return call


distrax.Distribution.sample = _lenient(distrax.Distribution.sample)
distrax.Distribution.sample_and_log_prob = _lenient(distrax.Distribution.sample_and_log_prob)


class LineParams(NamedTuple):
    """Dynamics and reward on a line."""

    noise: Array | float = 0.0  # standard deviation of a step
    slope: Array | float = 1.0  # reward per unit of s'
    width: Array | float = 0.1  # sigma_p


@struct.dataclass
class Point:
    """Where, (1,), and when."""

    place: Array
    time: Array


@dataclasses.dataclass(frozen=True)
class Line(Environment):
    """s' = s + 0.1 a + noise xi, r = slope s'. Ends beyond 0.25, and the time is up after `horizon` steps."""

    horizon: int = 8

    observation_size = 1
    action_space = Box(1)
    event_names = ("arrived",)

    def reset(self, key: Array, params: LineParams) -> tuple[Point, Array]:
        place = jax.random.uniform(key, (1,), minval=-0.1, maxval=0.1)
        return Point(place, jnp.zeros((), jnp.int32)), place

    def step(self, key: Array, state: Point, action: Array, params: LineParams) -> Step:
        place = state.place + 0.1 * action + params.noise * jax.random.normal(key, (1,))
        after = Point(place, state.time + 1)
        arrived = place[0] > 0.25
        late = (after.time >= self.horizon) & ~arrived
        return Step(after, place, self.reward(state, action, after, params), arrived, late, arrived[None])

    def reward(self, state: Point, action: Array, next_state: Point, params: LineParams) -> Array:
        return params.slope * next_state.place[0]

    def next_state_distribution(self, state: Point, action: Array, params: LineParams) -> Gaussian:
        return Gaussian(state.place + 0.1 * action, jnp.asarray(params.noise), self.perception_width(params))

    def perceive(self, state: Point) -> Array:
        return state.place

    def perception_width(self, params: LineParams) -> Array:
        return jnp.broadcast_to(jnp.asarray(params.width), (1,))


class ProbeParams(NamedTuple):
    """What a probe pays."""

    last: Array | float = 1.0  # reward of the last step
    choice: Array | float = 0.0  # reward of the best action less that of the worst


@dataclasses.dataclass(frozen=True)
class Probe(Environment):
    """`horizon` steps that are told apart, and a reward at the last; then it ends, or only the time is up."""

    horizon: int = 1
    ends: bool = True
    action_space: ActionSpace = Box(1)

    observation_size = 1

    def _point(self, time: Array) -> Point:
        return Point(jnp.minimum(time, self.horizon - 1).astype(jnp.float32)[None], time)

    def reset(self, key: Array, params: ProbeParams) -> tuple[Point, Array]:
        state = self._point(jnp.zeros((), jnp.int32))
        return state, state.place

    def step(self, key: Array, state: Point, action: Array, params: ProbeParams) -> Step:
        after = self._point(state.time + 1)
        over = after.time >= self.horizon
        reward = self.reward(state, action, after, params)
        return Step(after, after.place, reward, over & self.ends, over & (not self.ends), jnp.zeros(0, bool))

    def quality(self, action: Array) -> Array:
        """1 of the best action, 0 of the worst."""
        if isinstance(self.action_space, Discrete):
            return action / (self.action_space.size - 1)
        return 1 - 0.25 * (action[0] - 1) ** 2

    def reward(self, state: Point, action: Array, next_state: Point, params: ProbeParams) -> Array:
        return params.last * (next_state.time >= self.horizon) + params.choice * self.quality(action)

    def perceive(self, state: Point) -> Array:
        return state.place

    def perception_width(self, params: ProbeParams) -> Array:
        return jnp.ones(1)


# every size is given, so that no test hangs on a default
TINY = dict(
    method="peps", total_steps=160, num_envs=4, rollout_length=10, warmup_steps=40, batch_size=16, updates_per_step=0.1,
    hidden_sizes=(8,), model_hidden_sizes=(8,), ensemble_size=3, dynamics_updates=3, surrogate_updates=3,
    surrogate_batch_size=8, num_queries=20, segment_length=5, min_segment_length=1, query_strategy="information_gain",
    candidates_per_query=10, level="none", tune_temperature=False, reward_scale=1.0, prior="observed", bound=1.0,
)  # fmt: skip


def settings(config: Config) -> Settings:
    """Every part's settings."""
    return prepare(config).settings


def untrained(config: Config) -> FinishedRun:
    """A run as a sweep has them, of an agent that has learned nothing yet."""
    training = prepare(config)
    state = jax.jit(init)(training)
    return FinishedRun(training, state.agents, state.knowledge, state.preferences, curves={})


@pytest.fixture(scope="session")
def tiny() -> Config:
    """A training of four rounds on D1."""
    return Config(env="nav-d1", **TINY)


@pytest.fixture(scope="session")
def line() -> Config:
    """A training of four rounds on a line, of which the human thinks that it is noisy."""
    return Config(env=Line(), params=LineParams(), belief=LineParams(noise=0.1), **TINY)


@pytest.fixture(scope="session")
def train():
    """`peps_jax.train`, compiled once for every structure."""
    return jax.jit(peps_jax.train)


@pytest.fixture(scope="session")
def compiled(tmp_path_factory, worker_id):
    """The environment of processes that run sweeps; all tests and workers share what they compile."""
    base = tmp_path_factory.getbasetemp()
    return compiling_into((base if worker_id == "master" else base.parent) / "compiled")
