"""Roll-outs of MuJoCo models, by the environments that are made of them and by MuJoCo itself."""

import functools

import jax
import mujoco
import numpy as np


@functools.partial(jax.jit, static_argnums=0)
def begun(environment, params, key=None):
    """The state and the observation in which an episode begins."""
    return environment.reset(jax.random.key(0) if key is None else key, params)


@functools.partial(jax.jit, static_argnums=0)
def stepped(environment, state, action, params):
    """One step."""
    return environment.step(jax.random.key(0), state, action, params)


def rolled_out(environment, params, actions):
    """Positions after each action, (steps, nq)."""
    return np.asarray(_rolled_out(environment, params, actions))


@functools.partial(jax.jit, static_argnums=0)  # compiled once for all models of an environment
def _rolled_out(environment, params, actions):
    state, _ = environment.reset(jax.random.key(0), params)
    step = lambda state, action: (environment.step(jax.random.key(0), state, action, params).state,) * 2
    return jax.lax.scan(step, state, actions)[1].inner.qpos


def in_mujoco(model, actions, substeps=1, start=()):
    """The same of MuJoCo, whose first positions are `start`, and controls as far as they go at an action of 1."""
    data, places = mujoco.MjData(model), []
    data.qpos[: len(start)] = start
    for action in actions:
        data.ctrl[:] = action * model.actuator_ctrlrange[:, 1]
        mujoco.mj_step(model, data, substeps)
        places.append(data.qpos.copy())
    return np.array(places)
