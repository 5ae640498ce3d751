"""What every physics task offers beside its environment."""

import jax
import numpy as np
import pytest

import peps_envs
from peps_envs import physics, registry

pytest.importorskip("mujoco")


@pytest.mark.parametrize("name", registry.PHYSICS)
def test_what_is_misjudged_is_what_truth_and_belief_differ_in(name):
    task, about = peps_envs.make(f"mjx-{name}"), physics.misjudged(f"mjx-{name}")
    assert about.true != about.believed
    equal = lambda one, other: jax.tree.map(np.testing.assert_array_equal, one, other)
    equal(about.belief(about.true), task.params)
    equal(about.belief(about.believed), task.beliefs[task.default_belief])
    assert jax.tree.structure(about.belief(4 * about.true)) == jax.tree.structure(task.params), "they can be stacked"
