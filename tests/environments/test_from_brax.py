"""Brax's environments with beliefs: the same steps bit by bit, what a belief's step may not take over, and trainings."""

import copy
import functools
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import TINY

from peps_jax import Config

with warnings.catch_warnings():  # a library that Brax imports announces its retirement
    warnings.filterwarnings("ignore", "JAXopt is no longer maintained", DeprecationWarning)
    from brax import envs
    from brax.envs.wrappers.training import EpisodeWrapper

    from peps_envs.bridges.from_brax import from_brax


# as programs are compiled outside of tests; otherwise the last bit depends on what else is in a program
OPTIMIZED = {"xla_backend_optimization_level": 3, "xla_cpu_use_fusion_emitters": True}

pytestmark = [
    pytest.mark.filterwarnings("ignore:Brax System:UserWarning"),  # it says who maintains it
    pytest.mark.filterwarnings("ignore:Accessing `:DeprecationWarning"),  # how Brax uses MJX
]


@functools.cache
def reacher(backend="positional"):
    env = envs.get_environment("reacher", backend=backend)
    weak = env.sys.tree_replace({"actuator.gear": 0.4 * env.sys.actuator.gear})
    return from_brax(env, env.sys, lambda state: state.obs[-3:-1], width=(0.003, 0.003), horizon=50), weak


@functools.cache
def hopper():
    env = envs.get_environment("hopper", backend="positional")
    moon = env.sys.replace(gravity=env.sys.gravity / 6)
    return from_brax(env, env.sys, lambda state: state.pipeline_state.q[:2], width=(0.02, 0.02)), moon


@pytest.fixture(autouse=True)
def _lenient():
    with jax.numpy_rank_promotion("allow"):  # Brax mixes ranks
        yield


@pytest.mark.long
@pytest.mark.parametrize("make", [reacher, hopper])
def test_random_steps_are_braxs_bit_by_bit(make):
    """20 000, of 100 walks at once."""
    environment, _ = make()
    env = environment.env

    def theirs(state, action, system):
        own = copy.copy(env)
        own.sys = system
        return own.step(state.replace(metrics=dict(state.metrics)), action)

    batched = lambda step: jax.jit(jax.vmap(step, (0, 0, None)), compiler_options=OPTIMIZED)
    mine = batched(lambda state, action, system: environment.step(jax.random.key(0), state, action, system))
    theirs = batched(theirs)
    keys = jax.random.split(jax.random.key(0), 100)
    state = jax.jit(jax.vmap(lambda key: environment.reset(key, env.sys)[0]))(keys)
    their = state.inner
    for key in jax.random.split(jax.random.key(1), 200):
        action = jax.random.uniform(key, (100, env.action_size), minval=-1.0)
        state, their = mine(state, action, env.sys).state, theirs(their, action, env.sys)
        np.testing.assert_array_equal(state.reward, their.reward)
        same = jax.tree.map(np.array_equal, state.inner, their)
        assert jax.tree.all(same)


@pytest.mark.parametrize(
    "backend",
    ["positional", "spring", *(pytest.param(name, marks=pytest.mark.slow) for name in ("generalized", "mjx"))],
)
def test_a_beliefs_step_knows_nothing_of_the_true_system(backend):
    """A heavier arm, from a state that the true system made, moves as from one that it has made itself."""
    environment, _ = reacher(backend)
    env = environment.env
    heavy = env.sys.tree_replace(
        {"link.inertia.mass": 3 * env.sys.link.inertia.mass, "body_mass": 3 * env.sys.body_mass}
    )
    key, push, moved = jax.random.key(0), jnp.ones(2), {}
    for name, system in (("true", env.sys), ("heavy", heavy)):
        state, _ = jax.jit(environment.reset)(key, system)
        adopted = jax.jit(environment.adopted)(state, heavy)
        if name == "true" and backend != "mjx":
            assert not np.array_equal(mass_of(state.inner.pipeline_state), mass_of(adopted.inner.pipeline_state))
        after = jax.jit(environment.step)(key, adopted, push, heavy).state.inner.pipeline_state
        moved[name] = after.q, after.qd
    jax.tree.map(lambda one, other: np.testing.assert_allclose(one, other, rtol=1e-4, atol=5e-5), *moved.values())


def mass_of(state):
    return state.mass if hasattr(state, "mass") else state.mass_mx


def test_the_truth_surprises_nobody_who_knows_it():
    environment, weak = reacher()
    system, push, key = environment.env.sys, jnp.ones(2), jax.random.key(0)
    state, _ = jax.jit(environment.reset)(key, system)
    before = jax.jit(environment.step)(key, state, push, system).state
    after = jax.jit(environment.step)(key, before, push, system).state

    @jax.jit
    def surprise(params):
        expected = environment.next_state_distribution(before, push, params)
        return expected.relative_log_prob(environment.perceive(after))

    assert surprise(system) > -1e-3
    assert surprise(weak) < -0.005


@pytest.mark.long
@pytest.mark.parametrize("make", [reacher, hopper])
def test_a_training_with_a_belief(make, train):
    environment, belief = make()
    result = train(Config(env=environment, params=environment.env.sys, belief=belief, **TINY))
    assert np.all(np.isfinite(result.curves["explicability"]))


def test_what_cannot_work_is_said_in_one_line():
    environment, _ = reacher()
    env, see = environment.env, environment.see
    with pytest.raises(ValueError, match=r"^EpisodeWrapper: Brax's wrappers merge ends and time limits; give the"):
        from_brax(EpisodeWrapper(env, 10, 1), env.sys, see, width=(1.0, 1.0))

    class Pixels(type(env)):
        def reset(self, rng):
            return super().reset(rng).replace(obs=jnp.zeros((8, 8, 3)))

    with pytest.raises(ValueError, match=r"^Pixels: observations of shape \(8, 8, 3\), such as pixels, aren't"):
        from_brax(Pixels(backend="positional"), env.sys, see, width=(1.0, 1.0))
    other = envs.get_environment("hopper", backend="positional").sys
    with pytest.raises(ValueError, match=r"^Reacher: parameters of another structure \(nq, nv, nu, .*\) need another"):
        environment.reset(jax.random.key(0), other)
