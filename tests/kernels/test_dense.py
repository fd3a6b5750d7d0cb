"""The perceptron as kernels: outputs and gradients are those of JAX, for any sizes."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

from flytune.control.policy import make_network
from flytune.kernels.batched import available
from flytune.kernels.dense import perceptron, plain
from flytune.kernels.native import module, register
from flytune.kernels.writer import Writer

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
    weights = [rng.normal(size=pair) / pair[0] ** 0.5 for pair in layers]
    parameters = np.concatenate([*(weight.ravel() for weight in weights), rng.normal(size=sum(sizes[1:]))])
    inputs, cotangent = (rng.normal(size=(size, batch)) for size in (sizes[0], sizes[-1]))
    return [jnp.asarray(each, jnp.float32) for each in (parameters, inputs, cotangent)]


@pytest.mark.parametrize("squash", [True, False])
@pytest.mark.parametrize(("sizes", "batch"), CASES)
def test_outputs_and_gradients_are_those_of_jax(sizes, batch, squash):
    parameters, inputs, cotangent = drawn(sizes, batch)

    def value_and_gradient(function):
        def weighed(parameters, inputs):
            return jnp.sum(cotangent * function(parameters, sizes, inputs, squash=squash))

        outputs = function(parameters, sizes, inputs, squash=squash)
        return outputs, jax.jit(jax.grad(weighed, argnums=(0, 1)))(parameters, inputs)

    found, expected = value_and_gradient(perceptron), value_and_gradient(plain)
    assert jax.tree.structure(found) == jax.tree.structure(expected)
    for one, other in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(one, other, atol=3e-6 * batch**0.5, rtol=2e-5)


@pytest.mark.parametrize("columns", [1, 3, 7, 8, 9, 16])
@pytest.mark.parametrize("rows", [4, 8, 64])
def test_a_transposition_writes_nothing_behind_its_matrix(rows, columns):
    room, size = 1024, rows * columns
    writer = Writer()
    writer.copy(None, "%out0", size + room)
    writer.transpose("%in0", "%out0", rows, columns)
    given = np.zeros(size + room, np.float32)
    given[:size] = np.arange(1, size + 1)
    name, text = module([writer.function("turned", 1, 1)], "turned", 1, 1)
    register(name, text)
    kind = jax.ShapeDtypeStruct((size + room,), jnp.float32)
    (found,) = jax.ffi.ffi_call(name, [kind])(jnp.asarray(np.where(given == 0, 7.0, given), jnp.float32))
    np.testing.assert_array_equal(found[:size], given[:size].reshape(rows, columns).T.ravel())
    assert not np.asarray(found[size:]).any()


def test_infinite_and_missing_numbers_stay_visible():
    sizes = (17, 64, 64, 4)
    parameters, inputs, _ = drawn(sizes, 64)
    inputs = inputs.at[3, 5].set(jnp.nan)
    outputs = np.asarray(perceptron(parameters, sizes, inputs))
    assert np.isnan(outputs[:, 5]).all() and np.isfinite(np.delete(outputs, 5, axis=1)).all()


def test_the_vector_of_parameters_is_a_network_in_order():
    network = make_network(jax.random.key(0), (17, 12, 10, 4), last_gain=1.0)
    inputs = jax.random.normal(jax.random.key(1), (17, 20))
    found = perceptron(ravel_pytree(network)[0], network.sizes, inputs)
    np.testing.assert_allclose(found, network(inputs.T).T, atol=2e-6)
