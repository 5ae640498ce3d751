"""gymnax's environments with beliefs. Importing this module imports gymnax.

    env, params = gymnax.make("Pendulum-v1")
    pendulum = from_gymnax(env, params, lambda state: jnp.stack([jnp.cos(state.theta), jnp.sin(state.theta)]), width=(0.1, 0.1))
    train(Config(env=pendulum, params=params, belief=params.replace(m=2.0)))  # looks twice as heavy as it is

Actions are scaled to [-1, 1]. gymnax's own time limit is the horizon. Its reward is part of its step, which nobody can ask what
another step would have been worth: a human is taken to want what the environment pays, unless `reward` says more.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from gymnax.environments import spaces
from gymnax.environments.environment import Environment as Gymnax
from jax import Array

from peps_envs.bridges.simulated import Simulator, Structure, check_flat
from peps_envs.environment import Bounds, Box, Discrete

LOOKED_AT = 16, 32  # episodes and steps of each, to see whether observations hide something


@dataclasses.dataclass(frozen=True, kw_only=True)
class FromGymnax(Simulator):
    """See `from_gymnax`."""

    env: Gymnax
    low: tuple[float, ...]  # of gymnax's actions; empty where they are discrete
    high: tuple[float, ...]
    observe: Callable[[Any], Array] | None

    def start(self, key: Array, params: Any) -> tuple[Any, Array]:
        observation, inner = self.env.reset_env(key, params)
        return inner, observation if self.observe is None else self.observe(inner)

    def advance(self, key: Array, inner: Any, action: Array, params: Any) -> tuple[Any, Array, Array, Array]:
        observation, after, reward, terminated, _ = self.env.step_env(key, inner, self.scaled(action), params)
        return after, observation if self.observe is None else self.observe(after), reward, terminated

    def scaled(self, action: Array) -> Array:
        """An action of [-1, 1]^n as gymnax means it."""
        if not self.low:
            return action
        low, high = jnp.asarray(self.low), jnp.asarray(self.high)
        return (high + low) / 2 + (high - low) / 2 * jnp.clip(action, -1.0, 1.0)


def from_gymnax(
    env: Gymnax,
    params: Any,
    perceive: Callable[[Any], Array],
    width: Sequence[float],
    *,
    observe: Callable[[Any], Array] | None = None,
    reward: Callable[[Any, Array, Any, Any], Array] | None = None,
    random_draws: int = 1,
) -> FromGymnax:
    """`env` as an environment; its parameters, true ones and beliefs, are gymnax's with other numbers in them.

    Args:
      params: the true ones; action limits and the horizon are theirs.
      perceive: (gymnax's state) -> what people compare of it, (perceived_size,).
      width: sigma_p of that, (perceived_size,).
      observe: (gymnax's state) -> (observation_size,), instead of gymnax's observation.
      reward: (state, action in [-1, 1], next state, params) -> what that is worth, instead of what gymnax pays for the step.
      random_draws: where chance is in the steps, from how many of them a belief's density is estimated.

    Raises:
      ValueError: observations are pixels or in parts, or they hide something of the state that matters.
    """
    name, space = env.name, env.action_space(params)
    if not isinstance(space, spaces.Box | spaces.Discrete):
        raise ValueError(f"{name}: actions of {type(space).__name__} aren't supported; Box and Discrete are")
    bounds = lambda limit: tuple(np.broadcast_to(np.asarray(limit, float), space.shape).tolist())
    continuous = isinstance(space, spaces.Box)
    observation, state = jax.eval_shape(env.reset_env, jax.random.key(0), params)
    observation = observation if observe is None else jax.eval_shape(observe, state)
    check_flat(observation, name)
    made = FromGymnax(
        horizon=int(params.max_steps_in_episode),
        observation_size=observation.shape[0],
        action_space=Box(space.shape[0]) if continuous else Discrete(space.n),
        observation_space=Bounds(),
        random_draws=random_draws,
        see=perceive,
        width=tuple(width),
        reward_of=reward,
        structure=Structure.of(params),
        name=name,
        env=env,
        low=bounds(space.low) if continuous else (),
        high=bounds(space.high) if continuous else (),
        observe=observe,
    )
    hidden = _hidden(made, params)
    if hidden:
        raise ValueError(
            f"{name}: observations hide {hidden!r} of the state, on which what follows depends; give `observe`"
        )
    return made


def _hidden(environment: FromGymnax, params: Any) -> str | None:
    """A field of the state that isn't observed and yet decides what follows; None if there is none to be found.

    States of random episodes get each field of another one in turn: where that changes nothing that is observed, it must change
    neither what is observed next, nor the reward, nor the end.
    """
    env, space = environment.env, environment.action_space
    episodes, steps = LOOKED_AT

    def act(key: Array) -> Array:
        if isinstance(space, Discrete):
            return jax.random.randint(key, (), 0, space.size)
        return jax.random.uniform(key, (space.size,), minval=-1.0)

    def episode(key: Array) -> Any:
        def move(state: Any, key: Array) -> tuple[Any, Any]:
            return environment.step(key, state, act(key), params).state, state

        state, _ = environment.reset(key, params)
        return jax.lax.scan(move, state, jax.random.split(key, steps))[1].inner

    def seen(inner: Any) -> Array:
        if environment.observe is not None:
            return environment.observe(inner)
        return env.observe(jax.random.key(0), inner, None, params)

    def follows(inner: Any, key: Array) -> Array:
        _, observation, reward, terminated = environment.advance(key, inner, act(key), params)
        parts = [jnp.asarray(part, float).reshape(-1) for part in (observation, reward, terminated)]
        return jnp.concatenate(parts)

    @jax.jit
    def compare(key: Array) -> Array:
        """For each field, whether some state's was hidden and mattered."""
        states = jax.vmap(episode)(jax.random.split(key, episodes))
        leaves, tree = jax.tree.flatten(jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), states))
        swapped = lambda place, leaf: jnp.roll(leaf, steps + 1, 0) if place == 0 else leaf
        variants = [
            [swapped(place - other, leaf) for other, leaf in enumerate(leaves)] for place in range(-1, len(leaves))
        ]
        variants = jax.tree.unflatten(tree, [jnp.stack(found) for found in zip(*variants, strict=True)])
        keys = jax.random.split(key, episodes * steps)
        observed = jax.vmap(jax.vmap(seen))(variants)
        later = jax.vmap(lambda states: jax.vmap(follows)(states, keys))(variants)
        differs = lambda values: jnp.any(jnp.abs(values[1:] - values[:1]) > 1e-5, axis=-1)
        return jnp.any(~differs(observed) & differs(later), axis=-1)

    fields = [jax.tree_util.keystr(path).lstrip(".") for path, _ in jax.tree.leaves_with_path(
        jax.eval_shape(env.reset_env, jax.random.key(0), params)[1])]  # fmt: skip
    return next((field for field, found in zip(fields, compare(jax.random.key(0)), strict=True) if found), None)
