"""Networks: the gradient that is written out is the one that JAX finds."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import linen as nn

from peps_jax.learning import networks


def differentiated(layers, rows, normalised):
    """The same network, differentiated by JAX."""
    norm = nn.RMSNorm(epsilon=1e-5, use_scale=False)
    for layer in layers[:-1]:
        rows = rows @ layer.kernel + layer.bias[None]
        rows = nn.relu(norm.apply({}, rows) if normalised else rows)
    return rows @ layers[-1].kernel + layers[-1].bias[None]


# no hidden layer, narrow ones; wide ones: a first that is computed again or not, several after it, few and many outputs
@pytest.mark.parametrize(
    "sizes", [(3, 2), (3, 16, 8, 1), (9, 40, 1), (3, 40, 40, 4), (12, 40, 40, 12), (3, 40, 8, 20, 12)]
)
@pytest.mark.parametrize("members", [None, 3])
@pytest.mark.parametrize("normalised", [False, True])
def test_gradient_is_that_of_jax(sizes, members, normalised):
    network = networks.MLP(sizes[1:-1], sizes[-1], normalised=normalised)
    keys = jax.random.split(jax.random.key(0), 3)
    features = jax.random.normal(keys[0], (5, 7, sizes[0]))
    if members is None:
        params, over = network.init(keys[1], features), lambda apply: apply
    else:
        params = networks.init_ensemble(network, keys[1], members, sizes[0])
        over = lambda apply: jax.vmap(apply, in_axes=(0, None))
    # biases start at 0: others tell a gradient that forgets them
    params = jax.tree.map(lambda leaf: leaf + 0.1 * jax.random.normal(keys[2], leaf.shape), params)

    def plainly(params, features):
        tree = params["params"]
        layers = [networks.Layer(**tree[f"Dense_{place}"]) for place in range(len(tree))]
        outputs = differentiated(layers, features.reshape(-1, sizes[0]), normalised)
        return outputs.reshape(*features.shape[:-1], sizes[-1])

    loss = lambda apply: lambda params, features: jnp.sum(jnp.sin(over(apply)(params, features)))
    found, expected = (
        jax.jit(jax.value_and_grad(loss(apply), argnums=(0, 1)))(params, features) for apply in (network.apply, plainly)
    )
    jax.tree.map(lambda one, other: np.testing.assert_allclose(one, other, rtol=1e-4, atol=1e-5), found, expected)


@pytest.mark.parametrize("units", [8, 40])
def test_one_observation_is_a_row_of_many(units):
    network = networks.MLP((units, units), 2)
    rows = jax.random.normal(jax.random.key(0), (4, 3))
    params = network.init(jax.random.key(1), rows[0])
    many = network.apply(params, rows)
    np.testing.assert_allclose(network.apply(params, rows[2]), many[2], rtol=1e-5)
    assert many.shape == (4, 2)
