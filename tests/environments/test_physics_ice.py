"""A sled at black ice: two routes, steps beside MuJoCo's own, what is believed, and what is drawn."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import peps_envs
from peps_envs.scene import Circle, Polyline, Rectangle

mujoco = pytest.importorskip("mujoco")
pytest.importorskip("mujoco.mjx")

from mjx_cases import begun, in_mujoco, rolled_out  # noqa: E402

from peps_envs.physics import ice  # noqa: E402

OVER_ICE = ((1.7, 1.1), (1.7, 1.1))
OVER_SNOW = ((-1.3, 1.12), (1.7, 1.12))
LAMBDA = 2.4


def thrust(place, velocity, aim):
    """Full thrust towards `aim`, with less of it the faster the sled is."""
    ahead = aim - place
    force = 4 * ahead / jnp.sqrt(jnp.sum(ahead**2)) - 0.8 * velocity
    return force / jnp.maximum(1.0, jnp.max(jnp.abs(force)))


@pytest.fixture(scope="module")
def drive():
    """(two points to go by) -> states, returns, l_H under the biased belief, and whether the sled arrived, step by step."""
    environment, params, beliefs = peps_envs.make("mjx-ice")

    def step(carry, _):
        state, passed, under_way, way = carry
        place, velocity = state.inner.qpos[:2], state.inner.qvel[:2]
        passed |= jnp.sum((way[0] - place) ** 2) < 0.35**2
        action = thrust(place, velocity, jnp.where(passed, way[1], way[0]))
        after = environment.step(jax.random.key(0), state, action, params)
        expected = environment.next_state_distribution(state, action, beliefs["biased"])
        worth = jnp.stack([after.reward, expected.relative_log_prob(environment.perceive(after.state))])
        carry = (after.state, passed, under_way & ~after.terminated, way)
        return carry, (after.state.inner.qpos, worth * under_way, under_way, after.events[0] & under_way)

    @jax.jit
    def run(way):
        state, _ = environment.reset(jax.random.key(0), params)
        carry = (state, jnp.zeros((), bool), jnp.ones((), bool), way)
        return jax.lax.scan(step, carry, None, 40)[1]

    return lambda way: jax.device_get(run(jnp.array(way)))


def test_the_ice_is_quicker_and_the_snow_is_as_expected(drive):
    (_, quick, ice_steps, slid), (_, slow, snow_steps, walked) = drive(OVER_ICE), drive(OVER_SNOW)
    assert slid.any()
    assert walked.any()
    assert 5 <= snow_steps.sum() - ice_steps.sum() <= 10
    (quick_return, surprise), (slow_return, expected) = quick.sum(0), slow.sum(0)
    assert 90 < slow_return < quick_return < 97
    assert 2 <= quick_return - slow_return <= 0.05 * quick_return
    assert expected > -1
    assert surprise < -10
    margin = (1 + LAMBDA) * (slow_return - quick_return) + LAMBDA * (expected - surprise)
    assert margin > 10


@pytest.mark.parametrize("friction", [ice.ICE, ice.ASPHALT])
def test_steps_are_mujocos_with_that_friction(friction):
    """Over the ice, into the eastern end, to and fro on snow and shore."""
    times = np.arange(100)[:, None]
    actions = np.concatenate([np.sin(times / 7), 0.8 * np.cos(times / 5)], 1)
    compiled = ice.model(friction)
    expected = in_mujoco(compiled, actions, ice.SUBSTEPS, ice.START)
    assert expected[:, 0].max() > ice.SHORE[0] + 0.5
    with jax.enable_x64(True):
        environment = peps_envs.make("mjx-ice").environment
        exact = rolled_out(environment, environment.model(compiled), actions)
    np.testing.assert_allclose(exact, expected, atol=1e-6)


def test_on_ice_the_sled_loses_what_its_friction_takes():
    """Gliding over ice, m/s lost in 0.4 s are mu g t, of the true and of the believed model alike."""
    for friction in (ice.ICE, ice.SNOW):
        model = ice.model(friction)
        model.dof_damping[:] = 0
        data = mujoco.MjData(model)
        height = ice.SLOPE * (ice.SHORE[0] - ice.START[0])
        data.qpos[:], data.qvel[0] = (0.0, -1.0, -height), 2.0
        mujoco.mj_step(model, data, 8)
        np.testing.assert_allclose(2.0 - data.qvel[0], friction * 9.81 * 0.4, rtol=0.15)


def test_the_scene_has_pond_goal_and_sled_in_view():
    task = peps_envs.make("mjx-ice")
    state, observation = begun(task.environment, task.params)
    assert observation.shape == (8,)
    assert np.abs(observation).max() <= 1
    scene = task.environment.scene(jax.device_get(state), task.params)
    left, right, low, high = scene.extent
    for shape in scene.shapes:
        if isinstance(shape, Rectangle):
            corners = [(shape.x + side * shape.width / 2, shape.y + side * shape.height / 2) for side in (-1, 1)]
        elif isinstance(shape, Circle):
            corners = [(shape.x + side * shape.radius, shape.y + side * shape.radius) for side in (-1, 1)]
        else:
            assert isinstance(shape, Polyline)
            corners = shape.points
        for x, y in corners:
            assert left - 1e-6 <= x <= right + 1e-6
            assert low - 1e-6 <= y <= high + 1e-6
    sled = scene.shapes[-1]
    np.testing.assert_allclose((sled.x, sled.y), ice.START, atol=1e-6)
    assert {"ice", "goal", "agent"} <= {shape.colour for shape in scene.shapes}
