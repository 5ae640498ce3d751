"""The known-model planner, against a corridor that one can solve by hand, and on the domain where ways part."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import peps_envs
from peps_envs.environment import event
from peps_envs.navigation import Navigation, inside, make_params
from peps_jax.analysis import navigation_planner

# One row, the goal from x = 4.9 on. Grid points every 0.375, so that full and half steps lead from one to another.
corridor = partial(make_params, size=(6.0, 1.0), start=(0.375, 0.5), goal=(4.9, 0.0, 6.0, 1.0))
CORRIDOR = corridor()
ALIGNED = 17
GAMMA = 0.97


def corridor_value(x, step=-1.0, progress=1.0, length=0.75):
    """The best return from x: full steps until one reaches the goal, which is sooner and brings progress earlier."""
    to_go = np.maximum(4.9 - x, 0)
    full = np.maximum(np.ceil(to_go / length), 1) - 1  # from inside the goal, too, an episode takes one step to end
    before = (step + progress * length) * (1 - GAMMA**full) / (1 - GAMMA)
    return before + GAMMA**full * (step + progress * (to_go - full * length) + 100)


@partial(jax.jit, static_argnames=("objective", "resolution"))
def row(params, belief, objective, lam, resolution=ALIGNED):
    """Values on the middle row of the corridor's grid, and the residual."""
    plan = navigation_planner.solve(params, belief, objective, lam, gamma=GAMMA, resolution=resolution, directions=4)
    return plan.values[resolution // 2], plan.residual


def places(resolution=ALIGNED):
    """x of the same."""
    return np.linspace(0, 6, resolution)


@partial(jax.jit, static_argnames=("objective", "resolution", "directions"))
def walk(params, belief, objective, resolution, directions):
    """30 steps of the plan: what each brought, and whether the episode went on until then."""
    environment = Navigation()
    plan = navigation_planner.solve(
        params, belief, objective, resolution=resolution, directions=directions, tolerance=0.1
    )

    def step(carry, key):
        state, alive = carry
        action, _ = plan.policy(environment.observe(state, params), None)
        after = environment.step(key, state, action, params)
        return (after.state, alive & ~after.terminated), (after, alive)

    start, _ = environment.reset(jax.random.key(0), params)
    return jax.lax.scan(step, (start, True), jax.random.split(jax.random.key(0), 30))[1]


def test_the_corridor_is_solved_exactly():
    values, residual = row(CORRIDOR, CORRIDOR, "return", 0.0)
    np.testing.assert_allclose(values, corridor_value(places()), rtol=1e-4)
    assert residual <= 1e-3


def test_the_plan_walks_the_corridor():
    steps, alive = walk(CORRIDOR, CORRIDOR, "return", ALIGNED, 4)
    assert jnp.sum(alive) == 7
    assert event(Navigation(), steps.events, "goal_reached")[6]
    np.testing.assert_allclose(jnp.sum(steps.reward[:7]), 100 - 7 + 4.525, rtol=1e-5)  # undiscounted


def test_the_human_counts_with_a_reward_of_its_own():
    belief = corridor(step_reward=-0.5, progress_reward=2.0)
    values, _ = row(CORRIDOR, belief, "human", 0.0)
    np.testing.assert_allclose(values, corridor_value(places(), step=-0.5, progress=2.0), rtol=1e-4)


def test_the_human_plans_in_believed_dynamics():
    belief = corridor(step_length=0.375)
    values, _ = row(CORRIDOR, belief, "human", 0.0)
    np.testing.assert_allclose(values, corridor_value(places(), length=0.375), rtol=1e-4)


def test_eq_6_with_a_human_who_believes_the_truth_is_the_return_rescaled():
    values, _ = row(CORRIDOR, CORRIDOR, "peps", 0.5)
    np.testing.assert_allclose(values, 1.5 * corridor_value(places()), rtol=1e-4)


def test_eq_6_charges_what_the_human_does_not_expect():
    """Who believes in steps of 0.65 misses a full step by half a perceptual width: l_H = -1/8. From x = 0 all 7 are full."""
    belief = corridor(step_length=0.65)
    values, _ = row(CORRIDOR, belief, "peps", 0.5)
    surprise = (1 - GAMMA**7) / (1 - GAMMA) / 8
    np.testing.assert_allclose(values[0], 1.5 * corridor_value(0.0) - 0.5 * surprise, rtol=1e-4)


def test_without_lambda_eq_6_is_the_return():
    belief = corridor(step_length=0.5, ice=(2.0, 0.0, 3.0, 1.0), ice_noise=0.4)
    np.testing.assert_allclose(
        row(CORRIDOR, belief, "peps", 0.0)[0], row(CORRIDOR, belief, "return", 0.0)[0], atol=1e-3
    )


def test_a_finer_grid_is_nearer_the_truth():
    errors = []
    for resolution in (16, 32, 64, 128):  # none of them aligned with the steps
        values, _ = row(CORRIDOR, CORRIDOR, "return", 0.0, resolution)
        errors.append(np.mean(np.abs(values - corridor_value(places(resolution)))))
    assert np.all(np.diff(errors) < 0)
    assert errors[-1] < 0.1


def test_an_unknown_objective_is_refused():
    with pytest.raises(
        ValueError, match=r"^objective 'retrun' is unknown: did you mean 'return'\? known are .*human, peps$"
    ):
        navigation_planner.solve(CORRIDOR, CORRIDOR, "retrun")


@pytest.mark.parametrize(
    ("objective", "ice", "sand"), [("return", True, False), pytest.param("peps", False, True, marks=pytest.mark.slow)]
)
def test_ways_part_in_the_fourth_domain(objective, ice, sand):
    task = peps_envs.make("nav-d4")
    steps, alive = walk(task.params, task.beliefs["biased"], objective, 49, 16)  # grid points on every edge of the map
    assert jnp.any(alive & event(task.environment, steps.events, "goal_reached"))

    def crossed(ground):
        return bool(jnp.any(alive & jax.vmap(inside, in_axes=(0, None))(steps.state.position, ground)))

    assert (crossed(task.params.ice), crossed(task.params.sand)) == (ice, sand)
