"""DARC's classifier: what tells belief and truth apart, and by how much."""

import jax
import jax.numpy as jnp
import numpy as np
from conftest import settings

from peps_jax.learning import classifier
from peps_jax.trajectory import Transition

ROWS = 4096
SHIFT = 1.5  # of the imagined movement, in units of sigma_p


def transitions(key, shift):
    """Steps that move by the action, of which the human thinks that they move by `shift` more, seen through the kernel."""
    key_action, key_imagined = jax.random.split(key)
    action = jax.random.uniform(key_action, (ROWS, 1), minval=-1.0)
    nothing = jnp.zeros(ROWS)
    return Transition(
        observation=jnp.zeros((ROWS, 1)), action=action, reward=nothing, next_observation=jnp.zeros((ROWS, 1)), movement=action,
        terminated=nothing > 0, human_reward=nothing, log_belief=nothing,
        imagined=action + shift + jax.random.normal(key_imagined, (ROWS, 1)),
    )  # fmt: skip


def fitted(line, shift, rounds=12):
    own = settings(line.replace(dynamics_updates=100, dynamics_learning_rate=5e-3, model_hidden_sizes=(16,))).dynamics
    rows = transitions(jax.random.key(0), shift)
    state = classifier.init(jax.random.key(1), own)
    fit = jax.jit(lambda state, key: classifier.fit(state, rows, jnp.asarray(ROWS), jax.random.split(key), own))
    for index in range(rounds):
        state, info = fit(state, jax.random.key(index))
    return state, rows, own, float(info["classifier_loss"])


def test_the_ratio_is_that_of_the_densities(line):
    """l_H - l_A at what happened: -shift^2 / 2, and 0 where the human expects just that."""
    state, rows, own, _ = fitted(line, SHIFT)
    found = classifier.log_ratio(state, rows, own)
    np.testing.assert_allclose(jnp.mean(found), -(SHIFT**2) / 2, atol=0.25)
    as_imagined = classifier.log_ratio(state, rows._replace(movement=rows.action + SHIFT), own)
    np.testing.assert_allclose(jnp.mean(as_imagined), SHIFT**2 / 2, atol=0.25)


def test_who_believes_the_truth_is_never_told_apart(line):
    state, rows, own, loss = fitted(line, 0.0)
    assert abs(loss - np.log(2)) < 0.02
    assert float(jnp.mean(jnp.abs(classifier.log_ratio(state, rows, own)))) < 0.2
