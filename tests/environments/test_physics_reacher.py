"""mjx-reacher: two ways to the goal, of which people expect one; roll-outs beside MuJoCo's own."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

mujoco = pytest.importorskip("mujoco")
pytest.importorskip("mujoco.mjx")

from mjx_cases import begun, in_mujoco, rolled_out  # noqa: E402

import peps_envs  # noqa: E402
from peps_envs.physics import reacher  # noqa: E402

NUDGE = 0.03  # of the motor's torque, with which the arm begins to fall to the left


@pytest.fixture
def task():
    return peps_envs.make("mjx-reacher")  # kept by the registry


def under(state):
    """Falls to the left; the motor makes up for the shoulder's friction, and a tenth more."""
    nudge = NUDGE * (state.time < 2)
    return jnp.stack([1.1 * reacher.FRICTION * state.inner.qvel[0] / reacher.SHOULDER - nudge, 0.0])


def over(state):
    """All torque to the right."""
    del state
    return jnp.array([1.0, 0.0])


@jax.jit
def run(params, believed, upwards):
    """The steps of an episode over the top or under the shoulder, and l_H of each."""
    environment = peps_envs.make("mjx-reacher").environment

    def step(state, _):
        action = jnp.where(upwards, over(state), under(state))
        after = environment.step(jax.random.key(0), state, action, params)
        expected = environment.next_state_distribution(state, action, believed)
        return after.state, (after, expected.relative_log_prob(environment.perceive(after.state)))

    return jax.lax.scan(step, environment.reset(jax.random.key(0), params)[0], None, environment.horizon)[1]


@functools.cache
def walk(policy, belief="biased"):
    """The states of an episode, its return, l_H and length in steps, and whether it reached the goal."""
    task = peps_envs.make("mjx-reacher")
    environment = task.environment
    steps, log_belief = jax.device_get(run(task.params, task.beliefs[belief], policy is over))
    reached = bool(steps.terminated.any())
    length = int(np.argmax(steps.terminated)) + 1 if reached else environment.horizon
    return steps.state, float(steps.reward[:length].sum()), float(log_belief[:length].sum()), length, reached


def test_over_the_top_is_short_and_surprises():
    states, value, log_belief, length, reached = walk(over)
    assert reached
    assert length <= 8
    assert value >= 94
    assert log_belief < -15
    assert states.inner.perceived[: length - 1, 1].min() > 0.5, "never low"


def test_the_way_under_is_longer_and_looks_as_expected():
    states, value, log_belief, length, reached = walk(under)
    assert reached
    assert 12 <= length <= 14
    assert value >= 90
    assert -1 < log_belief < 0
    assert states.inner.perceived[:length, 1].min() < -0.9, "below the shoulder"


def test_the_agents_own_way_costs_more_than_it_saves():
    """r_A alone is for the way over the top, by 2 at least, r_A + 2.4 (r_H + l_H) for the one under, by 10 at least."""
    _, short, surprise, *_ = walk(over)
    _, long, expected, *_ = walk(under)
    assert short - long >= 2
    assert long >= 0.95 * short
    assert (1 + 2.4) * (long - short) + 2.4 * (expected - surprise) >= 10


def test_who_knows_the_mass_is_never_surprised():
    *_, log_belief, _, _ = walk(over, "unbiased")
    assert log_belief > -1e-6


@pytest.mark.parametrize("payload", [reacher.PAYLOAD, reacher.LOOKS, 24.0])
def test_a_roll_out_is_mujocos_of_that_payload(task, payload):
    steps = 100
    times = np.arange(steps)
    actions = np.stack([np.sin(times / 6), np.where(times % 20 < 10, 1.0, -1.0)], 1)
    compiled = reacher.model(payload)
    expected = in_mujoco(compiled, actions, reacher.SUBSTEPS)
    with jax.enable_x64(True):
        places = rolled_out(task.environment, task.environment.model(compiled), actions)
    assert np.ptp(expected, axis=0).min() > 0.5, "both joints move"
    np.testing.assert_allclose(places, expected, atol=1e-6)


def test_the_payloads_velocity_is_its_places_derivative(task):
    environment = task.environment
    state, _ = begun(environment, task.params)
    inner = state.inner._replace(qpos=jnp.array([0.7, -0.4]), qvel=jnp.array([1.5, -2.0]))

    @jax.jit
    def both(inner):
        at = lambda qpos: reacher.place(environment._data(inner._replace(qpos=qpos), task.params))
        _, speed = jax.jvp(at, (inner.qpos,), (inner.qvel,))
        return reacher.velocity(environment._data(inner, task.params)), speed

    np.testing.assert_allclose(*both(inner), atol=1e-5)


def test_the_scene_lies_within_its_extent(task):
    states, *_, length, _ = walk(under)
    for moment in range(length):
        state = jax.tree.map(lambda leaf, moment=moment: leaf[moment], states)
        scene = task.environment.scene(state, task.params)
        left, right, low, high = scene.extent
        assert all(left <= shape.x <= right and low <= shape.y <= high for shape in scene.shapes)
        payload = scene.shapes[-1]
        np.testing.assert_allclose([payload.x, payload.y], state.inner.perceived, atol=1e-5)
