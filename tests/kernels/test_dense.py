"""The perceptron as kernels: outputs and gradients are those of JAX, for any sizes."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from flytune.kernels.batched import available
from flytune.kernels.dense import perceptron, plain

pytestmark = pytest.mark.skipif(not available(), reason="no kernels on this machine")

CASES = [  # sizes of the layers, batch
    ((17, 64, 64, 4), 64),
    ((17, 64, 64, 1), 128),
    ((3, 5, 1), 7),
    ((2, 3), 1),
    ((21, 32, 16, 8, 4), 100),
    ((17, 13, 9, 2), 33),
]


def drawn(sizes, batch):
    rng = np.random.default_rng(0)
    layers = list(itertools.pairwise(sizes))
    weights = tuple(jnp.asarray(rng.normal(size=pair) / pair[0] ** 0.5, jnp.float32) for pair in layers)
    biases = tuple(jnp.asarray(rng.normal(size=more), jnp.float32) for _, more in layers)
    inputs, cotangent = (jnp.asarray(rng.normal(size=(size, batch)), jnp.float32) for size in (sizes[0], sizes[-1]))
    return (weights, biases, inputs), cotangent


@pytest.mark.parametrize("squash", [True, False])
@pytest.mark.parametrize(("sizes", "batch"), CASES)
def test_outputs_and_gradients_are_those_of_jax(sizes, batch, squash):
    arguments, cotangent = drawn(sizes, batch)

    def value_and_gradient(function):
        def weighed(*given):
            return jnp.sum(cotangent * function(*given, squash=squash))

        return function(*arguments, squash=squash), jax.jit(jax.grad(weighed, argnums=(0, 1, 2)))(*arguments)

    found, expected = value_and_gradient(perceptron), value_and_gradient(plain)
    assert jax.tree.structure(found) == jax.tree.structure(expected)
    for one, other in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(one, other, atol=3e-6 * batch**0.5, rtol=2e-5)


def test_infinite_and_missing_numbers_stay_visible():
    (weights, biases, inputs), _ = drawn((17, 64, 64, 4), 64)
    inputs = inputs.at[3, 5].set(jnp.nan)
    outputs = np.asarray(perceptron(weights, biases, inputs))
    assert np.isnan(outputs[:, 5]).all() and np.isfinite(np.delete(outputs, 5, axis=1)).all()
