"""Brax's environments with beliefs. Importing this module imports Brax.

    env = brax.envs.get_environment("reacher", backend="positional")
    reacher = from_brax(env, env.sys, lambda state: state.obs[-3:-1], width=(0.01, 0.01), horizon=50)
    weak = env.sys.tree_replace({"actuator.gear": 0.4 * env.sys.actuator.gear})
    train(Config(env=reacher, params=env.sys, belief=weak))

Brax's states hold what followed from the system that made them, such as masses and the matrix of them. A belief's step is made from
the same pose and velocities with that anew, so that the true system's doesn't count. Gears, friction, damping and gravity may be
replaced in a system; a belief about masses or sizes is a second system, loaded from a model with those (`brax.io.mjcf.loads`), for
constants that are derived from them stay what they were otherwise.

Brax's reward is part of its step, which nobody can ask what another step would have been worth: a human is taken to want what the
environment pays, unless `reward` says more. Whether Brax's observations hide something isn't looked at.
"""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import jax
from brax import com, kinematics
from brax.envs.base import PipelineEnv, State, Wrapper
from jax import Array

from peps_envs.bridges.simulated import SimulatedState, Simulator, Structure, check_flat
from peps_envs.environment import Bounds, Box


@dataclasses.dataclass(frozen=True, kw_only=True)
class FromBrax(Simulator):
    """See `from_brax`."""

    env: PipelineEnv
    observe: Callable[[State], Array] | None

    def start(self, key: Array, params: Any) -> tuple[State, Array]:
        inner = self._with(params).reset(key)
        return inner, self._seen(inner)

    def advance(self, key: Array, inner: State, action: Array, params: Any) -> tuple[State, Array, Array, Array]:
        del key  # Brax's steps have no chance in them but what is in their state
        # Brax's environments write into the metrics that they are given
        inner = inner.replace(metrics=dict(inner.metrics), info=dict(inner.info))
        after = self._with(params).step(inner, action)
        return after, self._seen(after), after.reward, after.done > 0.5

    def adopted(self, state: SimulatedState, params: Any) -> SimulatedState:
        env, before = self._with(params), state.inner.pipeline_state
        if env.backend == "mjx":  # which derives everything at a step's beginning
            return state
        if env.backend == "generalized":
            pipeline = env.pipeline_init(before.q, before.qd)
        else:
            x_i, xd_i = com.from_world(params, before.x, before.xd)
            j, jd, a_p, a_c = kinematics.world_to_joint(params, before.x, before.xd)
            mass = params.link.inertia.mass ** (1 - params.spring_mass_scale)
            pipeline = before.replace(x_i=x_i, xd_i=xd_i, j=j, jd=jd, a_p=a_p, a_c=a_c, mass=mass)
            if env.backend == "spring":
                pipeline = pipeline.replace(i_inv=com.inv_inertia(params, before.x))
        return state.replace(inner=state.inner.replace(pipeline_state=pipeline))

    def _with(self, params: Any) -> PipelineEnv:
        env = copy.copy(self.env)
        env.sys = params
        return env

    def _seen(self, inner: State) -> Array:
        return inner.obs if self.observe is None else self.observe(inner)


@dataclasses.dataclass(frozen=True)
class SystemStructure(Structure):
    """Of a system, apart from the model that it was loaded from, which is another object each time."""

    @classmethod
    def of(cls, params: Any) -> Structure:
        return super().of(params.replace(mj_model=None))


def from_brax(
    env: PipelineEnv,
    system: Any,
    perceive: Callable[[State], Array],
    width: Sequence[float],
    *,
    horizon: int = 1_000,
    observe: Callable[[State], Array] | None = None,
    reward: Callable[[State, Array, State, Any], Array] | None = None,
) -> FromBrax:
    """`env` as an environment; its parameters, true ones and beliefs, are Brax systems.

    Args:
      system: the true one, such as `env.sys`.
      perceive: (Brax's state) -> what people compare of it, (perceived_size,).
      width: sigma_p of that, (perceived_size,).
      horizon: steps after which time is up.
      observe: (Brax's state) -> (observation_size,), instead of Brax's observation.
      reward: (state, action, next state, system) -> what that is worth, instead of what Brax pays for the step.

    Raises:
      ValueError: `env` is in wrappers, or its observations are pixels or in parts.
    """
    name = type(env).__name__
    if isinstance(env, Wrapper):
        raise ValueError(f"{name}: Brax's wrappers merge ends and time limits; give the environment without them")
    state = jax.eval_shape(env.reset, jax.random.key(0))
    observation = state.obs if observe is None else jax.eval_shape(observe, state)
    check_flat(observation, name)
    return FromBrax(
        horizon=horizon,
        observation_size=observation.shape[0],
        action_space=Box(env.action_size),
        observation_space=Bounds(),
        random_draws=1,
        see=perceive,
        width=tuple(width),
        reward_of=reward,
        structure=SystemStructure.of(system),
        name=name,
        env=env,
        observe=observe,
    )
