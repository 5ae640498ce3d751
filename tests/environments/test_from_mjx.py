"""MuJoCo models with beliefs: roll-outs beside MuJoCo's own, masses that can't be replaced, and what can't work."""

import copy
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import TINY

from peps_envs.scene import Circle, Scene
from peps_jax import Config

mujoco = pytest.importorskip("mujoco")
mjx = pytest.importorskip("mujoco.mjx")

from mjx_cases import begun, in_mujoco, rolled_out, stepped  # noqa: E402

from peps_envs.bridges.from_mjx import from_mjx  # noqa: E402

PUSH = """
<mujoco model="push">
  <option timestep="0.01" tolerance="1e-10"/>
  <worldbody>
    <body name="pusher">
      <joint name="x" type="slide" axis="1 0 0" damping="4"/>
      <joint name="y" type="slide" axis="0 1 0" damping="4"/>
      <geom name="hand" type="sphere" size="0.1" mass="1"/>
    </body>
    <body name="ball" pos="0.4 0.02 0">
      <joint name="u" type="slide" axis="1 0 0" damping="1" frictionloss="0.5"/>
      <joint name="v" type="slide" axis="0 1 0" damping="1" frictionloss="0.5"/>
      <geom name="ball" type="sphere" size="0.15" mass="{mass}" contype="{contype}"/>
    </body>
  </worldbody>
  <actuator>
    <motor joint="x" gear="20" ctrlrange="-1 1"/>
    <motor joint="y" gear="20" ctrlrange="-2 2"/>
  </actuator>
</mujoco>"""
STEPS = 100


def compiled(mass, contype=1):
    return mujoco.MjModel.from_xml_string(PUSH.format(mass=mass, contype=contype))


def far(data, action, after, model):
    return after.xpos[2, 0] - data.xpos[2, 0] - 0.01 * jnp.sum(action**2)


def draw(model, data):
    ball = Circle(*map(float, data.geom("ball").xpos[:2]), float(model.geom("ball").size[0]), "other")
    return Scene((ball,), (-1.0, 2.0, -1.0, 1.0))


@functools.cache
def push(**changes):
    settings = dict(horizon=STEPS, scene=draw) | changes
    return from_mjx(compiled(5.0), far, lambda data: data.xpos[2, :2], (0.02, 0.02), **settings)


def controls(steps=STEPS):
    """Ahead, with some wobbling, so that the ball is hit more than once."""
    times = np.arange(steps)[:, None]
    return np.concatenate([np.where(times % 50 < 40, 1.0, -1.0), 0.2 * np.sin(times / 5)], 1)


@pytest.mark.parametrize("mass", [5.0, 1.0])
def test_a_roll_out_is_mujocos_of_the_model_that_was_compiled_with_that_mass(mass):
    expected = in_mujoco(compiled(mass), controls())
    assert expected[-1, 2] > 0.05, "the ball is hit"
    with jax.enable_x64(True):
        environment = push()
        exact = rolled_out(environment, environment.model(compiled(mass)), controls())
    np.testing.assert_allclose(exact, expected, atol=1e-6)
    np.testing.assert_allclose(rolled_out(push(), push().model(compiled(mass)), controls()), expected, atol=2e-3)


def test_a_mass_cannot_be_replaced_in_a_compiled_model():
    """MuJoCo's own model is refused; in MJX's it moves otherwise than what has been compiled."""
    environment = push()
    replaced = compiled(1.0)
    replaced.body_mass[2] = 5.0
    with pytest.raises(
        ValueError, match=r"^push: body_subtreemass, .* don't follow from its masses and sizes; compile a"
    ):
        environment.model(replaced)
    with jax.enable_x64(True):
        light, heavy = environment.model(compiled(1.0)), environment.model(compiled(5.0))
        alone = light.replace(body_mass=heavy.body_mass)
        both = alone.replace(body_inertia=heavy.body_inertia)
        expected = in_mujoco(compiled(5.0), controls())
        for model in (alone, both):
            assert np.abs(rolled_out(environment, model, controls()) - expected).max() > 1e-4


def test_friction_may_be_replaced():
    environment = push()
    sticky = compiled(5.0)
    sticky.dof_frictionloss[2:] = 2.0
    moved = rolled_out(environment, environment.model(sticky), controls())
    np.testing.assert_allclose(moved, in_mujoco(sticky, controls()), atol=2e-3)


def test_random_steps_are_mjxs_bit_by_bit():
    """20 000, of 200 walks at once."""
    environment = push()
    model = environment.model(compiled(5.0))
    step = jax.jit(jax.vmap(lambda state, action: environment.step(jax.random.key(0), state, action, model)))

    @jax.jit
    @jax.vmap
    def theirs(data, action):
        with jax.numpy_rank_promotion("allow"):  # which MJX needs
            return mjx.step(model, data.replace(ctrl=action * jnp.array([1.0, 2.0])))

    keys = jax.random.split(jax.random.key(0), 200)
    states = jax.jit(jax.vmap(lambda key: environment.reset(key, model)[0]))(keys)
    data = jax.jit(jax.vmap(lambda _: mjx.make_data(compiled(5.0), impl="jax")))(jnp.arange(200))
    for key in jax.random.split(jax.random.key(1), 100):
        action = jax.random.uniform(key, (200, 2), minval=-1.0)
        states, data = step(states, action).state, theirs(data, action)
        for name in ("qpos", "qvel", "qacc_warmstart"):
            np.testing.assert_array_equal(getattr(states.inner, name), getattr(data, name))


def test_what_is_seen_and_paid_is_of_the_pose_after_the_step():
    environment = push()
    model, action = environment.model(compiled(5.0)), jnp.array([1.0, 0.0])
    state, observation = begun(environment, model)
    assert observation.shape == (environment.observation_size,) == (8,)
    for _ in range(60):
        before, state = state, stepped(environment, state, action, model).state
    ball = np.array([0.4, 0.02]) + state.inner.qpos[2:]
    assert ball[0] > 0.45
    np.testing.assert_allclose(environment.perceive(state), ball, rtol=1e-5)
    moved = state.inner.qpos[2] - before.inner.qpos[2]
    np.testing.assert_allclose(state.reward, moved - 0.01, atol=1e-5)
    reward = jax.jit(environment.reward)(before, action, state, model)
    np.testing.assert_allclose(reward, state.reward, atol=1e-6)
    (drawn,) = environment.scene(jax.device_get(state), model).shapes
    np.testing.assert_allclose([drawn.x, drawn.y, drawn.radius], [*ball, 0.15], rtol=1e-5)


def test_a_belief_expects_what_the_other_model_does():
    environment = push()
    heavy, light = (environment.model(compiled(mass)) for mass in (5.0, 1.0))
    action = jnp.array([1.0, 0.0])

    @jax.jit
    def surprise(state, after, model):
        return environment.next_state_distribution(state, action, model).relative_log_prob(environment.perceive(after))

    judged_step = jax.jit(lambda state: environment.judged_step(jax.random.key(0), state, action, heavy, light))
    state, _ = begun(environment, heavy)
    found = []
    for _ in range(60):
        after, judged = judged_step(state)
        found.append([*(surprise(state, after.state, model) for model in (heavy, light)), judged.log_belief])
        state = after.state
    knows, believes, side_by_side = np.array(found).T
    assert np.all(knows > -1e-6)
    assert believes.min() < -0.01
    np.testing.assert_allclose(side_by_side, believes, rtol=1e-3, atol=1e-5)


@pytest.mark.parametrize("watched", [1, 3])
def test_what_is_watched_is_judged_in_one_batch(watched):
    """Three balls side by side end where each ends alone, and are judged as each is."""
    environment = push()
    heavy, light = (environment.model(compiled(mass)) for mass in (5.0, 1.0))
    keys, actions = jax.random.split(jax.random.key(0), 3), jnp.array([[1.0, 0.0], [0.0, 1.0], [0.6, 0.2]])
    states, _ = jax.vmap(environment.reset, in_axes=(0, None))(keys, heavy)
    together = jax.jit(lambda states: environment.judged_steps(keys, states, actions, heavy, light, watched))
    alone = jax.jit(jax.vmap(lambda *told: environment.judged_step(*told, heavy, light)))
    surprises = []
    for _ in range(60):
        (after, judged), (own, each) = together(states), alone(keys, states, actions)
        np.testing.assert_allclose(after.state.inner.qpos, own.state.inner.qpos, rtol=1e-5, atol=1e-6)
        np.testing.assert_allclose(judged.log_belief, each.log_belief[:watched], rtol=1e-3, atol=1e-5)
        np.testing.assert_allclose(judged.imagined, each.imagined[:watched], rtol=1e-4, atol=1e-4)
        states = own.state
        surprises.append(judged.log_belief)
    assert np.min(surprises, 0)[0] < -0.01


@pytest.mark.long
def test_a_training_with_a_belief(train):
    environment = push()
    heavy, light = (environment.model(compiled(mass)) for mass in (5.0, 1.0))
    result = train(Config(env=environment, params=heavy, belief=light, **TINY))
    assert np.all(np.isfinite(result.curves["explicability"]))


def test_starts_and_ends_of_ones_own():
    def start(key, data):
        return data.replace(qpos=data.qpos.at[0].set(jax.random.uniform(key, (), minval=-1.0, maxval=-0.5)))

    environment = push(start=start, terminated=lambda data: data.qpos[0] < -0.4, substeps=3)
    model = environment.model(compiled(5.0))
    (one, _), (other, _) = (begun(environment, model, jax.random.key(seed)) for seed in (0, 1))
    assert one.inner.qpos[0] != other.inner.qpos[0]
    after = stepped(environment, one, jnp.zeros(2), model)
    assert bool(after.terminated)
    np.testing.assert_allclose(after.state.inner.time, 0.03, rtol=1e-5)


def test_what_cannot_work_is_said_in_one_line():
    environment = push()
    with pytest.raises(
        ValueError, match=r"^push: parameters of another structure \(body_contype, geom_contype.*\) need another progr"
    ):
        environment.model(compiled(5.0, contype=2))
    with pytest.raises(
        ValueError, match=r"^push: observations hide qvel, on which what follows depends; let `observe`"
    ):
        push(observe=lambda data: data.xpos[1:, :2].reshape(-1))
    with pytest.raises(ValueError, match=r"^push: observations of shape \(8, 8, 3\), such as pixels, aren't supported"):
        push(observe=lambda data: jnp.zeros((8, 8, 3)))
    unlimited = copy.copy(compiled(5.0))
    unlimited.actuator_ctrllimited[:] = 0
    with pytest.raises(ValueError, match=r"^push: every actuator needs a ctrlrange, to which actions"):
        from_mjx(unlimited, far, lambda data: data.qpos, (1.0,))
