"""mjx-box: two ways past a wall, of which people expect one; roll-outs beside MuJoCo's own."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

mujoco = pytest.importorskip("mujoco")
pytest.importorskip("mujoco.mjx")

from mjx_cases import begun, in_mujoco, rolled_out  # noqa: E402

import peps_envs  # noqa: E402
from peps_envs.physics import box  # noqa: E402

STEPS = 100


@pytest.fixture(scope="module")
def task():
    return peps_envs.make("mjx-box")


def push(state):
    """Straight ahead, through the doorway."""
    del state
    return jnp.array([1.0, 0.0])


def around(state):
    """Up along the wall, past its end and down to the goal."""
    x, y, _ = state.inner.qpos
    x0, _, x1, y1 = box.WALLS[1]
    past = (y < y1) | (x > x1 + 0.15)
    beyond = (x > x1 + 0.15)[None]
    up = jnp.array([x0 - 0.35, y1 + 0.4])
    across = jnp.array([x1 + 0.4, y1 + 0.35])
    down = jnp.array([x1 + 0.5, box.GOAL[3] - 0.2])
    aim = jnp.where(beyond, down, jnp.where(past, up, across))
    return jnp.clip(4 * (aim - jnp.stack([x, y])), -1.0, 1.0)


def walks(task):
    """Of `push`, then of `around`: places, return, l_H of each belief, length in steps, and whether it arrived."""
    environment = task.environment
    beliefs = jax.tree.map(lambda *leaves: jnp.stack(leaves), *task.beliefs.values())

    @jax.jit
    def run(params, beliefs, pushes):
        def step(state, _):
            action = jnp.where(pushes, push(state), around(state))
            after = environment.step(jax.random.key(0), state, action, params)
            expected = lambda belief: environment.next_state_distribution(state, action, belief)
            seen = environment.perceive(after.state)
            return after.state, (after, jax.vmap(lambda belief: expected(belief).relative_log_prob(seen))(beliefs))

        start, _ = environment.reset(jax.random.key(0), params)
        return jax.lax.scan(step, start, None, environment.horizon)[1]

    for pushes in (True, False):
        steps, log_beliefs = jax.device_get(run(task.params, beliefs, pushes))
        reached = bool(steps.terminated.any())
        length = int(np.argmax(steps.terminated)) + 1 if reached else environment.horizon
        told = dict(zip(task.beliefs, log_beliefs[:length].sum(0), strict=True))
        yield steps.state.inner.qpos[:length], float(steps.reward[:length].sum()), told, length, reached


@pytest.fixture(scope="module")
def routes(task):
    return tuple(walks(task))


def test_pushing_is_short_and_surprises_at_every_step(routes):
    places, value, log_beliefs, length, reached = routes[0]
    assert reached
    assert length <= 11
    assert value >= 94.5
    assert log_beliefs["biased"] < -20
    assert log_beliefs["heavy"] < -2
    assert log_beliefs["unbiased"] > -1e-3
    assert places[-1, 2] - box.BOX[0] > 1.0, "the box is out of the doorway"


def test_the_way_around_is_longer_and_looks_as_expected(routes):
    places, value, log_beliefs, length, reached = routes[1]
    assert reached
    assert length <= 18
    assert value >= 90
    assert min(log_beliefs.values()) > -1
    assert abs(places[-1, 2] - box.BOX[0]) < 0.03, "the box is still in the doorway"


def test_explicability_is_a_choice(routes):
    """Return alone is for pushing; with the default lambda the way around is worth more."""
    (_, pushed, surprise, *_), (_, walked, calm, *_) = routes
    assert 2 <= pushed - walked <= 0.05 * pushed
    objective = lambda value, log_belief: value + 2.4 * (value + log_belief)
    assert objective(walked, calm["biased"]) - objective(pushed, surprise["biased"]) > 10


@pytest.mark.parametrize("mass", [box.TRUE_MASS, box.LOOKS_LIGHT, box.LOOKS_HEAVY])
def test_a_roll_out_is_mujocos_of_a_box_of_that_mass(task, mass):
    times = np.arange(STEPS)
    actions = np.stack([np.where(times % 30 < 22, 0.9, -0.8), 0.2 * np.sin(times / 3)], 1)
    compiled = box.model(mass)
    expected = in_mujoco(compiled, actions, box.SUBSTEPS)
    assert np.ptp(expected[:, 2]) > 0.1, "the box is pushed"

    with jax.enable_x64(True):
        found = rolled_out(task.environment, task.environment.model(compiled), actions)
    np.testing.assert_allclose(found, expected, atol=1e-6)


def test_a_box_moves_as_its_weight_lets_it(routes):
    """Pushed steadily, at (force - mu m g) / damping; what is heavier than the force can move stays."""
    speed = lambda mass: (box.FORCE - box.FRICTION * mass * box.GRAVITY) / box.DAMPING
    assert speed(box.TRUE_MASS) == pytest.approx(0.76, abs=0.01)
    assert speed(box.LOOKS_LIGHT) == pytest.approx(1.35, abs=0.01)
    places, *_ = routes[0]
    steady = np.diff(places[-4:, 2]) / (box.SUBSTEPS * box.TIMESTEP)
    np.testing.assert_allclose(steady, speed(box.TRUE_MASS), rtol=0.02)


def test_what_there_is_to_see_is_in_view(task):
    state, observation = begun(task.environment, task.params)
    assert np.all(np.abs(observation) <= 1)
    scene = task.environment.scene(jax.device_get(state), task.params)
    left, right, low, high = scene.extent
    assert {"agent", "goal", "other", "wall"} <= {shape.colour for shape in scene.shapes}
    assert all(left < shape.x < right and low < shape.y < high for shape in scene.shapes)
