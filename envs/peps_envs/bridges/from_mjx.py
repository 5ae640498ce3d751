"""MuJoCo models with beliefs, stepped by MJX. Importing this module imports MuJoCo and MJX.

    heavy, light = (mujoco.MjModel.from_xml_string(xml.format(mass=mass)) for mass in (5.0, 1.0))
    push = from_mjx(heavy, reward, perceive=lambda data: data.qpos, width=(0.05, 0.05))
    train(Config(env=push, params=push.model(heavy), belief=push.model(light)))

A belief about masses or sizes is a second model that MuJoCo has compiled. Replacing a mass in a compiled one leaves what was
derived from it as it was, such as the inverse weights by which contacts are softened: that isn't the heavier one, and `model`
refuses it. Both models have one structure, so that one program serves both; what is NumPy in an `mjx.Model`, such as which geoms
may touch, is part of the program, and models that differ in it are refused.
"""

from __future__ import annotations

import contextlib
import copy
import dataclasses
import functools
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array

from peps_envs.bridges.simulated import SimulatedState, Simulator, Structure, check_flat
from peps_envs.environment import Bounds, Box
from peps_envs.scene import Scene

with contextlib.redirect_stdout(None):  # it prints that Warp isn't there, which nobody needs
    from mujoco import mjx

# what MuJoCo derives from masses and sizes at compilation
DERIVED = ("body_subtreemass", "body_invweight0", "dof_invweight0", "dof_M0", "tendon_invweight0", "actuator_acc0")
ROUNDING = 1e-6


class MjxState(NamedTuple):
    """All of a simulation that isn't derived anew at a step's beginning, and what is seen of it."""

    qpos: Array  # (nq,)
    qvel: Array  # (nv,)
    act: Array  # (na,)
    qacc_warmstart: Array  # (nv,) where the solver begins
    time: Array  # () s
    perceived: Array  # (perceived_size,)
    events: Array  # (events,) bool


@dataclasses.dataclass(frozen=True, kw_only=True)
class FromMjx(Simulator):
    """See `from_mjx`."""

    compiled: mujoco.MjModel  # the true one
    substeps: int
    look: Callable[[mjx.Data], Array]  # what people compare
    observe: Callable[[mjx.Data], Array]
    pays: Callable[[mjx.Data, Array, mjx.Data, mjx.Model], Array]
    ends: Callable[[mjx.Data], Array] | None
    begin: Callable[[Array, mjx.Data], mjx.Data] | None
    draw: Callable[[mujoco.MjModel, mujoco.MjData], Scene] | None
    event_names: tuple[str, ...]
    signs: tuple[Callable[[mjx.Data], Array], ...]  # of the events
    low: tuple[float, ...]  # of the controls
    high: tuple[float, ...]

    def model(self, compiled: mujoco.MjModel) -> mjx.Model:
        """A compiled model as this environment's parameters.

        Raises:
          ValueError: what was derived at its compilation isn't what would follow from it now, or it has another structure.
        """
        stale = _stale(compiled)
        if stale:
            raise ValueError(
                f"{self.name}: {', '.join(stale)} of the model don't follow from its masses and sizes; compile a second model "
                "instead of replacing them in a compiled one"
            )
        model = mjx.put_model(compiled, impl="jax")
        self.structure.check(model, self.name)
        return model

    def start(self, key: Array, params: mjx.Model) -> tuple[MjxState, Array]:
        data = mjx.make_data(self.compiled, impl="jax").replace(qpos=params.qpos0)
        data = self._posed(data if self.begin is None else self.begin(key, data), params)
        return self._kept(data), self.observe(data)

    @functools.partial(jax.jit, static_argnums=0)  # traced once, however often a program steps
    def advance(
        self, key: Array, inner: MjxState, action: Array, params: mjx.Model
    ) -> tuple[MjxState, Array, Array, Array]:
        del key  # MuJoCo's steps have no chance in them
        before = self._data(inner, params)
        data, _ = jax.lax.scan(
            lambda data, _: (self._stepped(data, params), None),
            before.replace(ctrl=self._control(action)),
            None,
            self.substeps,
        )
        data = self._posed(data, params)
        terminated = jnp.zeros((), bool) if self.ends is None else self.ends(data)
        return self._kept(data), self.observe(data), self.pays(before, action, data, params), terminated

    def reward(self, state: SimulatedState, action: Array, next_state: SimulatedState, params: mjx.Model) -> Array:
        before, after = (self._data(moment.inner, params) for moment in (state, next_state))
        return jnp.asarray(self.pays(before, action, after, params), state.reward.dtype).reshape(())

    def scene(self, state: SimulatedState, params: mjx.Model) -> Scene | None:
        """What `scene` draws of MuJoCo's own model and data, which it is given."""
        if self.draw is None:
            return None
        data = mujoco.MjData(self.compiled)
        data.qpos[:], data.qvel[:] = np.asarray(state.inner.qpos), np.asarray(state.inner.qvel)
        mujoco.mj_forward(self.compiled, data)
        return self.draw(self.compiled, data)

    @functools.partial(jax.jit, static_argnums=0)
    def _data(self, inner: MjxState, params: mjx.Model) -> mjx.Data:
        data = mjx.make_data(self.compiled, impl="jax").replace(
            qpos=inner.qpos,
            qvel=inner.qvel,
            act=inner.act,
            qacc_warmstart=inner.qacc_warmstart,
            time=inner.time,
        )
        return self._posed(data, params)

    def _posed(self, data: mjx.Data, params: mjx.Model) -> mjx.Data:
        """With bodies, geoms and sites where `qpos` puts them; a step leaves them where they were before it."""
        with _any_ranks():
            return mjx.kinematics(params, data)

    def _stepped(self, data: mjx.Data, params: mjx.Model) -> mjx.Data:
        with _any_ranks():
            return mjx.step(params, data)

    def _kept(self, data: mjx.Data) -> MjxState:
        events = jnp.asarray([sign(data) for sign in self.signs], bool)
        return MjxState(
            data.qpos, data.qvel, data.act, data.qacc_warmstart, jnp.asarray(data.time), self.look(data), events
        )

    def happened(self, inner: MjxState) -> Array:
        return inner.events

    def _control(self, action: Array) -> Array:
        low, high = jnp.asarray(self.low), jnp.asarray(self.high)
        return (high + low) / 2 + (high - low) / 2 * jnp.clip(action, -1.0, 1.0)


def from_mjx(
    model: mujoco.MjModel,
    reward: Callable[[mjx.Data, Array, mjx.Data, mjx.Model], Array],
    perceive: Callable[[mjx.Data], Array],
    width: Sequence[float],
    *,
    horizon: int = 200,
    substeps: int = 1,
    observe: Callable[[mjx.Data], Array] | None = None,
    terminated: Callable[[mjx.Data], Array] | None = None,
    events: Mapping[str, Callable[[mjx.Data], Array]] | None = None,
    start: Callable[[Array, mjx.Data], mjx.Data] | None = None,
    scene: Callable[[mujoco.MjModel, mujoco.MjData], Scene] | None = None,
) -> FromMjx:
    """`model` as an environment; its parameters, true ones and beliefs, are what its `model` makes of compiled models.

    Of the data that these functions are given, positions, velocities and what follows from the pose (`xpos`, `geom_xpos`,
    `site_xpos`, ...) are up to date. Controls are scaled from [-1, 1].

    Args:
      model: the true one, of which beliefs share the structure.
      reward: (data, action, next data, mjx model) -> what a step is worth; masses may differ from judge to judge.
      perceive: (data) -> what people compare, (perceived_size,).
      width: sigma_p of that, (perceived_size,).
      horizon: steps after which time is up.
      substeps: MuJoCo's steps in one of the environment.
      observe: (data) -> (observation_size,); positions, velocities and activations unless it is given.
      terminated: (data) -> whether the MDP has ended; never unless it is given.
      events: by their names, (data after a step) -> whether it happened.
      start: (key, data of the model's own pose) -> data of a start; that pose unless it is given.
      scene: (model, data of MuJoCo) -> what there is to see.

    Raises:
      ValueError: a control has no limits, or the observations are pixels or hide positions, velocities or activations.
    """
    name = _name_of(model)
    if model.nu == 0 or not np.all(model.actuator_ctrllimited):
        raise ValueError(f"{name}: every actuator needs a ctrlrange, to which actions in [-1, 1] are scaled")
    made = FromMjx(
        horizon=horizon,
        observation_size=0,
        action_space=Box(model.nu),
        observation_space=Bounds(),
        random_draws=1,
        see=_perceived,
        width=tuple(width),
        reward_of=None,
        structure=Structure.of(mjx.put_model(model, impl="jax")),
        name=name,
        compiled=model,
        substeps=substeps,
        look=perceive,
        observe=observe or _whole_state,
        pays=reward,
        ends=terminated,
        begin=start,
        draw=scene,
        event_names=tuple(events or ()),
        signs=tuple((events or {}).values()),
        low=tuple(model.actuator_ctrlrange[:, 0].tolist()),
        high=tuple(model.actuator_ctrlrange[:, 1].tolist()),
    )
    params = made.model(model)
    _, observation = jax.eval_shape(made.start, jax.random.key(0), params)
    check_flat(observation, name)
    hidden = [] if observe is None else _hidden(made, params)
    if hidden:
        raise ValueError(
            f"{name}: observations hide {', '.join(hidden)}, on which what follows depends; let `observe` show it"
        )
    return dataclasses.replace(made, observation_size=observation.shape[0])


def _any_ranks() -> contextlib.AbstractContextManager[Any]:
    """MJX mixes ranks, whatever its user allows."""
    return jax.numpy_rank_promotion("allow")


def _perceived(inner: MjxState) -> Array:
    return inner.perceived


def _whole_state(data: mjx.Data) -> Array:
    return jnp.concatenate([data.qpos, data.qvel, data.act])


def _stale(compiled: mujoco.MjModel) -> list[str]:
    """Names of derived constants that MuJoCo would derive otherwise now."""
    fresh = copy.copy(compiled)
    mujoco.mj_setConst(fresh, mujoco.MjData(fresh))
    differs = lambda name: not np.allclose(getattr(fresh, name), getattr(compiled, name), rtol=ROUNDING, atol=ROUNDING)
    return [name for name in DERIVED if differs(name)]


def _hidden(environment: FromMjx, params: mjx.Model) -> list[str]:
    """Those of positions, velocities and activations of which nothing at all is observed."""
    inner, _ = jax.jit(environment.start)(jax.random.key(0), params)

    @jax.jit
    def unseen(inner: MjxState, other: MjxState) -> Array:
        one, two = (environment.observe(environment._data(state, params)) for state in (inner, other))
        return jnp.all(one == two)

    names = [name for name in ("qpos", "qvel", "act") if getattr(inner, name).size]
    moved = lambda name: inner._replace(**{name: getattr(inner, name) + 0.1})
    return [name for name in names if unseen(inner, moved(name))]


def _name_of(model: mujoco.MjModel) -> str:
    """The model's name in its XML, the first of its names."""
    return bytes(model.names).split(b"\0")[0].decode() or "model"
