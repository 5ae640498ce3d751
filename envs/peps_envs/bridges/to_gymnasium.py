"""Environments of this package as Gymnasium environments. Importing this module imports Gymnasium, and registers an id for each.

    import gymnasium

    import peps_envs.bridges.to_gymnasium

    env = gymnasium.make("peps/NavD1-v0")  # of the task "nav-d1"; belief="biased": as the human thinks that it is
    envs = gymnasium.make_vec("peps/NavD1-v0", num_envs=16)  # one program for all of them

Observations and rewards are those of the environment, bit by bit. `terminated` and `truncated` are what the environment says, so no
id has `max_episode_steps`. `info` holds the events of a step by their names. What `scene` shows is rendered ("rgb_array").

All chance in an episode and those that follow comes from the seed that `reset` is given. The environments of a batch have the seeds
seed, seed + 1, ..., and each does what it would do alone, up to rounding.
"""

from __future__ import annotations

import functools
import re
from collections.abc import Sequence
from typing import Any, NamedTuple

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from gymnasium import spaces
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from jax import Array

from peps_envs import registry
from peps_envs.environment import ActionSpace, Discrete, Environment
from peps_envs.pictures import picture

FRAMES = 5  # a second, of a film of what is rendered
AUTORESETS = (AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP)


class Underway(NamedTuple):
    """Where an episode stands."""

    state: Any
    key: Array  # of all chance to come
    over: Array  # () bool, whether the next step starts an episode


class Seen(NamedTuple):
    """What Gymnasium is told of a step."""

    observation: Array
    reward: Array
    terminated: Array
    truncated: Array
    events: Array


class GymnasiumEnvironment(gymnasium.Env):
    """`environment` with the dynamics and rewards of `params`: the true ones or a belief's.

    Raises:
      ValueError: `render_mode` is none of its modes.
    """

    def __init__(self, environment: Environment, params: Any, render_mode: str | None = None):
        self.environment, self.params = environment, params
        self.metadata = _metadata(environment)
        self.render_mode = _checked(render_mode, self.metadata)
        self.observation_space = observation_space(environment, params)
        self.action_space = action_space(environment.action_space)
        self._underway: Underway | None = None

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        super().reset(seed=seed)
        fresh = seed is not None or self._underway is None
        key = _key(self.np_random) if fresh else self._underway.key
        self._underway, observation = _start(self.environment, key, self.params)
        return np.asarray(observation), {}

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict[str, bool]]:
        action = np.asarray(action, _action_type(self.environment.action_space))
        self._underway, seen = _advance(self.environment, self._underway, action, self.params)
        seen = jax.device_get(seen)
        info = dict(zip(self.environment.event_names, seen.events.tolist(), strict=True))
        return seen.observation, float(seen.reward), bool(seen.terminated), bool(seen.truncated), info

    def render(self) -> np.ndarray | None:
        """The environment's scene as (height, width, 3) uint8."""
        if self.render_mode is None:
            return None
        return picture(self.environment.scene(jax.device_get(self._underway.state), self.params))


class GymnasiumVectorEnvironment(VectorEnv):
    """`num_envs` of `environment` side by side, as one program.

    Args:
      autoreset_mode: when an episode that is over is followed by a new one: with the next step, whose action then doesn't count
        (Gymnasium's default), or with the same one, whose last observation is then in `infos["final_obs"]`.

    Raises:
      ValueError: `render_mode` or `autoreset_mode` is none of its modes.
    """

    def __init__(
        self,
        environment: Environment,
        params: Any,
        num_envs: int,
        render_mode: str | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
    ):
        if autoreset_mode not in [mode for known in AUTORESETS for mode in (known, known.value)]:
            known = ", ".join(repr(mode.value) for mode in AUTORESETS)
            raise ValueError(f"autoreset_mode {autoreset_mode!r}: choose one of {known}")
        self.environment, self.params, self.num_envs = environment, params, num_envs
        self.metadata = _metadata(environment) | {"autoreset_mode": AutoresetMode(autoreset_mode)}
        self.render_mode = _checked(render_mode, self.metadata)
        self.single_observation_space = observation_space(environment, params)
        self.single_action_space = action_space(environment.action_space)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._underway: Underway | None = None

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict]:
        seeds = [None] * self.num_envs if seed is None else seed
        if isinstance(seed, int):
            super().reset(seed=seed)
            seeds = range(seed, seed + self.num_envs)
        if len(seeds) != self.num_envs:
            raise ValueError(
                f"seed has {len(seeds)} numbers: give one, or one for each of {self.num_envs} environments"
            )
        before = [None] * self.num_envs if self._underway is None else list(self._underway.key)
        alone = [
            _key(seeding.np_random(seed)[0]) if seed is not None or key is None else key
            for seed, key in zip(seeds, before, strict=True)
        ]
        self._underway, observation = _start_all(self.environment, jnp.stack(alone), self.params)
        return np.array(observation), {}

    def step(self, actions: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        actions = np.asarray(actions, _action_type(self.environment.action_space))
        if self.metadata["autoreset_mode"] == AutoresetMode.NEXT_STEP:
            restarted = np.array(self._underway.over)
            self._underway, seen = _advance_all(self.environment, self._underway, actions, self.params)
            seen = Seen(*map(np.array, seen))  # copies: JAX's own can't be written to
            infos = self._infos(seen.events, ~restarted)
        else:
            self._underway, seen, observation = _advance_and_restart_all(
                self.environment, self._underway, actions, self.params
            )
            seen, over = Seen(*map(np.array, seen)), np.array(seen.terminated | seen.truncated)
            infos = self._infos(seen.events, ~over)
            if over.any():
                last = np.full(self.num_envs, None, object)
                for place in np.flatnonzero(over):
                    last[place] = seen.observation[place]
                infos |= {"final_obs": last, "_final_obs": over, "_final_info": over}
                infos["final_info"] = self._infos(seen.events, over)
            seen = seen._replace(observation=np.array(observation))
        return seen.observation, seen.reward.astype(float), seen.terminated, seen.truncated, infos

    def render(self) -> tuple[np.ndarray, ...] | None:
        """A picture of each environment."""
        if self.render_mode is None:
            return None
        states = jax.device_get(self._underway.state)
        rows = [jax.tree.map(lambda leaf, place=place: leaf[place], states) for place in range(self.num_envs)]
        return tuple(picture(self.environment.scene(row, self.params)) for row in rows)

    def _infos(self, events: np.ndarray, told: np.ndarray) -> dict[str, np.ndarray]:
        """Events (num_envs, ...) by name, where they are `told` (num_envs,); Gymnasium's "_name" says where."""
        named = {name: events[:, place] & told for place, name in enumerate(self.environment.event_names)}
        return named | {f"_{name}": told for name in named}


def observation_space(environment: Environment, params: Any) -> spaces.Box:
    """The bounds that the environment states; the largest number where it states none, for Gymnasium warns of infinity."""
    _, observation = jax.eval_shape(environment.reset, jax.random.key(0), params)
    most = np.finfo(observation.dtype).max
    low, high = (
        np.broadcast_to(np.clip(np.asarray(limit, observation.dtype), -most, most), observation.shape)
        for limit in (environment.observation_space.low, environment.observation_space.high)
    )
    return spaces.Box(low, high, observation.shape, observation.dtype)


def action_space(space: ActionSpace) -> spaces.Box | spaces.Discrete:
    """Gymnasium's word for `space`."""
    return spaces.Discrete(space.size) if isinstance(space, Discrete) else spaces.Box(-1.0, 1.0, (space.size,))


def make(name: str, belief: str | None = None, render_mode: str | None = None) -> GymnasiumEnvironment:
    """The task called `name`, as it is or as its human believes that it is."""
    return GymnasiumEnvironment(*_domain(name, belief), render_mode)


def make_vec(name: str, num_envs: int = 1, belief: str | None = None, **settings: Any) -> GymnasiumVectorEnvironment:
    """`num_envs` of the task called `name`; `settings` as in `GymnasiumVectorEnvironment`."""
    return GymnasiumVectorEnvironment(*_domain(name, belief), num_envs, **settings)


def id_of(name: str) -> str:
    """The id of the task called `name`: "peps/NavD1-v0" of "nav-d1"."""
    return f"peps/{''.join(part[:1].upper() + part[1:] for part in re.split(r'[^A-Za-z0-9]+', name))}-v0"


def register_ids() -> None:
    """Gives every task that has none an id; for tasks that were registered after this module had been imported."""
    for name in registry.names():
        if id_of(name) not in gymnasium.registry:
            here, settings = f"{__name__}:", {"name": name}
            gymnasium.register(id_of(name), f"{here}make", vector_entry_point=f"{here}make_vec", kwargs=settings)


def _domain(name: str, belief: str | None) -> tuple[Environment, Any]:
    task = registry.make(name)
    if belief is None:
        return task.environment, task.params
    if belief not in task.beliefs:
        raise ValueError(registry.unknown_name("belief", belief, task.beliefs))
    return task.environment, task.beliefs[belief]


def _metadata(environment: Environment) -> dict[str, Any]:
    drawn = type(environment).scene is not Environment.scene
    return {"render_modes": ["rgb_array"] if drawn else [], "render_fps": FRAMES}


def _checked(render_mode: str | None, metadata: dict[str, Any]) -> str | None:
    if render_mode not in (None, *metadata["render_modes"]):
        raise ValueError(f"render_mode {render_mode!r}: this environment has {metadata['render_modes'] or 'none'}")
    return render_mode


def _key(generator: np.random.Generator) -> Array:
    return jax.random.key(int(generator.integers(2**31)))


def _action_type(space: ActionSpace) -> type:
    return np.int32 if isinstance(space, Discrete) else np.float32


@functools.partial(jax.jit, static_argnames="environment")
def _start(environment: Environment, key: Array, params: Any) -> tuple[Underway, Array]:
    key, key_start = jax.random.split(key)
    state, observation = environment.reset(key_start, params)
    return Underway(state, key, jnp.zeros((), bool)), observation


@functools.partial(jax.jit, static_argnames="environment")
def _advance(environment: Environment, underway: Underway, action: Array, params: Any) -> tuple[Underway, Seen]:
    key, key_step = jax.random.split(underway.key)
    after = environment.step(key_step, underway.state, action, params)
    seen = Seen(after.observation, after.reward, after.terminated, after.truncated, after.events)
    return Underway(after.state, key, after.terminated | after.truncated), seen


@functools.partial(jax.jit, static_argnames="environment")
def _start_all(environment: Environment, keys: Array, params: Any) -> tuple[Underway, Array]:
    return jax.vmap(_start, in_axes=(None, 0, None))(environment, keys, params)


@functools.partial(jax.jit, static_argnames="environment")
def _advance_all(environment: Environment, underway: Underway, actions: Array, params: Any) -> tuple[Underway, Seen]:
    """A step of all; where an episode was over it starts anew instead, which is worth nothing."""

    def move(underway: Underway, action: Array) -> tuple[Underway, Seen]:
        moved, seen = _advance(environment, underway, action, params)
        started, observation = _start(environment, underway.key, params)
        nothing = jax.tree.map(jnp.zeros_like, seen)._replace(observation=observation)
        return _where(underway.over, (started, nothing), (moved, seen))

    return jax.vmap(move)(underway, actions)


@functools.partial(jax.jit, static_argnames="environment")
def _advance_and_restart_all(
    environment: Environment, underway: Underway, actions: Array, params: Any
) -> tuple[Underway, Seen, Array]:
    """A step of all, what is seen of it, and the observation from which to go on: a new episode's where one is over."""

    def move(underway: Underway, action: Array) -> tuple[Underway, Seen, Array]:
        moved, seen = _advance(environment, underway, action, params)
        underway, observation = _where(moved.over, _start(environment, moved.key, params), (moved, seen.observation))
        return underway, seen, observation

    return jax.vmap(move)(underway, actions)


def _where(condition: Array, this: Any, that: Any) -> Any:
    return jax.tree.map(lambda this, that: jnp.where(condition, this, that), this, that)


register_ids()
