"""What every registered environment keeps to, whoever added it: shapes, ends, beliefs, densities and pictures."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import peps_envs
from peps_envs import Discrete, Scene
from peps_envs.environment import side_by_side
from peps_jax.drawing.panels import ROLES

STEPS = 20
NAMES = peps_envs.names()


@functools.cache
def seen(name: str) -> tuple:
    """A start, and what `judged_step` returned of a few random steps from there, and l and r under the truth and each belief."""
    task = peps_envs.make(name)
    environment, space = task.environment, task.environment.action_space
    whose = task.beliefs | {"truth": task.params}
    together = side_by_side(*whose.values())
    each = lambda of: dict(zip(whose, jax.vmap(of)(together), strict=True))  # compiled once for all of them

    def random_action(key):
        if isinstance(space, Discrete):
            return jax.random.randint(key, (), 0, space.size)
        return jax.random.uniform(key, (space.size,), minval=-1.0)

    def move(state, key):
        key_act, key_step = jax.random.split(key)
        action = random_action(key_act)
        after, judged = environment.judged_step(key_step, state, action, task.params, task.beliefs[task.default_belief])
        perceived = environment.perceive(after.state)
        density = lambda params: environment.next_state_distribution(state, action, params)
        surprises = each(lambda params: density(params).relative_log_prob(perceived))
        rewards = each(lambda params: environment.reward(state, action, after.state, params))
        return after.state, (after, perceived, surprises, rewards, judged)

    @jax.jit
    def walk(key):
        state, observation = environment.reset(key, task.params)
        return (state, observation), jax.lax.scan(move, state, jax.random.split(key, STEPS))[1]

    return walk(jax.random.key(0))


@pytest.mark.parametrize("name", NAMES)
def test_a_step_returns_what_it_has_to(name):
    environment = peps_envs.make(name).environment
    (_, first), (after, *_) = seen(name)
    assert first.shape == (environment.observation_size,)
    assert after.observation.shape == (STEPS, environment.observation_size)
    assert after.events.shape == (STEPS, len(environment.event_names))
    assert after.reward.shape == after.terminated.shape == after.truncated.shape == (STEPS,)
    assert {after.terminated.dtype, after.truncated.dtype, after.events.dtype} == {jnp.dtype(bool)}
    assert not np.any(after.terminated & after.truncated)
    assert np.all(np.isfinite(after.observation))
    assert np.all(np.isfinite(after.reward))


@pytest.mark.parametrize("name", NAMES)
def test_rewards_are_those_of_the_step(name):
    _, (after, _, _, rewards, _) = seen(name)
    np.testing.assert_allclose(rewards["truth"], after.reward, rtol=1e-5)


@pytest.mark.parametrize("name", NAMES)
def test_a_step_is_judged_as_its_parts_are(name):
    belief = peps_envs.make(name).default_belief
    _, (_, _, surprises, rewards, judged) = seen(name)
    np.testing.assert_allclose(judged.human_reward, rewards[belief], rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(judged.log_belief, surprises[belief], rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(judged.log_true, surprises["truth"], rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("name", NAMES)
def test_beliefs_are_values_of_the_same_parameters(name):
    task = peps_envs.make(name)
    assert {"biased", "unbiased"} <= set(task.beliefs)
    shapes = lambda params: (jax.tree.structure(params), list(map(jnp.shape, jax.tree.leaves(params))))
    assert all(shapes(belief) == shapes(task.params) for belief in task.beliefs.values())
    same = jax.tree.map(np.array_equal, task.beliefs["unbiased"], task.params)
    assert jax.tree.all(same)


@pytest.mark.parametrize("name", NAMES)
def test_densities_are_relative_to_the_kernel(name):
    task = peps_envs.make(name)
    _, (_, perceived, surprises, *_) = seen(name)
    width = task.environment.perception_width(task.params)
    assert perceived.shape == (STEPS, *width.shape)
    assert np.all(width > 0)
    for found in surprises.values():
        assert found.shape == (STEPS,)
        assert np.all(np.isfinite(found))
        assert np.all(found <= 1e-5)
    np.testing.assert_array_equal(surprises["unbiased"], surprises["truth"])


@pytest.mark.parametrize("name", NAMES)
def test_what_there_is_to_see_is_of_known_colours(name):
    task = peps_envs.make(name)
    (state, _), _ = seen(name)
    scene = task.environment.scene(state, task.params)
    assert scene is None or isinstance(scene, Scene)
    shapes = () if scene is None else scene.shapes
    assert {shape.colour for shape in shapes} <= set(ROLES)


def test_a_belief_that_differs_surprises_somebody():
    """The checks above look at something: in the domains of one's own package truth and belief aren't the same."""
    found = [seen(name)[1][2] for name in ("nav-d4", "highway-rain")]
    assert any(np.any(surprises["biased"] < surprises["truth"] - 0.1) for surprises in found)
