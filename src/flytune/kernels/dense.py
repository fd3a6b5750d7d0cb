"""A multilayer perceptron and its gradient as two kernels; all layers, biases and activations of a batch in one call.

XLA computes each product, bias, activation, transposition and sum of a small network by a call of its own, which takes
as long as the arithmetic. Here the batch is the last axis, so that the arithmetic runs along contiguous memory.
"""

import functools
import itertools
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from flytune.config.pytree import pytree, static
from flytune.kernels import elementary
from flytune.kernels.batched import available
from flytune.kernels.native import module, register
from flytune.kernels.writer import Writer


def perceptron(
    parameters: Float[Array, "P"], sizes: Sequence[int], inputs: Float[Array, "inputs N"], *, squash: bool = False
) -> Float[Array, "outputs N"]:
    """The outputs of a multilayer perceptron with tanh between its layers, for a batch along the last axis.

    Args:
        parameters: the weights [inputs, outputs] of all layers, then all biases, as one vector.
        sizes: of the inputs, the hidden layers and the outputs.
        inputs: of the first layer.
        squash: whether tanh also follows the last layer.
    """
    if not available():
        return plain(parameters, sizes, inputs, squash=squash)
    return _perceptron(tuple(sizes), squash, parameters, inputs)


def plain(parameters: Any, sizes: Sequence[int], inputs: Any, *, squash: bool = False) -> Any:
    """The same in JAX."""
    places = _places(sizes)
    for layer, (fewer, more) in enumerate(itertools.pairwise(sizes)):
        weight, bias = places[layer], places[len(sizes) - 1 + layer]
        product = parameters[weight : weight + fewer * more].reshape(fewer, more).T @ inputs
        inputs = product + parameters[bias : bias + more][:, None]
        inputs = jnp.tanh(inputs) if squash or layer < len(sizes) - 2 else inputs
    return inputs


def _places(sizes: Sequence[int]) -> list[int]:
    """Where the weights of each layer, then the biases of each layer, and the end lie in the vector of parameters."""
    lengths = [fewer * more for fewer, more in itertools.pairwise(sizes)] + list(sizes[1:])
    return [0, *itertools.accumulate(lengths)]


def parameters_of(sizes: Sequence[int]) -> int:
    """The number of parameters of a perceptron."""
    return _places(sizes)[-1]


@pytree
class Actor:
    """A perceptron that gives the actions in a rollout. The loop over time is then part of the kernel, see `window`."""

    parameters: Float[Array, "P"]  # see `perceptron`
    sizes: tuple[int, ...] = static()
    squash: bool = static()

    def __call__(self, memory: Any, observation: Float[Array, "N 17"], draw: Any, episodes: Any) -> Any:
        """The memory, actions [N, 4] and nothing to note."""
        return memory, perceptron(self.parameters, self.sizes, observation.T, squash=self.squash).T, ()


@functools.partial(jax.custom_vjp, nondiff_argnums=(0, 1))
def _perceptron(sizes: tuple[int, ...], squash: bool, parameters: Array, inputs: Array) -> Array:
    return _forward(sizes, squash, parameters, inputs)[0]


def _forward(sizes: tuple[int, ...], squash: bool, parameters: Array, inputs: Array) -> tuple[Array, Any]:
    number = inputs.shape[-1]
    text = forward_function("dense", sizes, number, squash)
    results = _call(text, [parameters, inputs], [(size, number) for size in sizes[1:]])
    return results[-1], (parameters, inputs, results)


def _backward(sizes: tuple[int, ...], squash: bool, kept: Any, cotangent: Array) -> tuple[Array, Array]:
    parameters, inputs, activations = kept
    shapes = [parameters.shape, inputs.shape] + [(max(sizes), inputs.shape[-1])] * 3
    text = backward_function("dense", sizes, inputs.shape[-1], squash)
    gradient, below, *_ = _call(text, [parameters, inputs, *activations, cotangent], shapes)
    return gradient, below


_perceptron.defvjp(_forward, _backward)


def _call(text: str, inputs: Sequence[Array], shapes: Sequence[tuple[int, ...]]) -> list[Array]:
    name, module_text = module([text], "dense", len(inputs), len(shapes))
    register(name, module_text)
    outputs = [jax.ShapeDtypeStruct(shape, jnp.float32) for shape in shapes]
    return list(jax.ffi.ffi_call(name, outputs, vmap_method="sequential")(*inputs))


@functools.cache
def forward_function(name: str, sizes: tuple[int, ...], number: int, squash: bool) -> str:
    """In LLVM: parameters, inputs -> the activations of every layer."""
    count, places = len(sizes) - 1, _places(sizes)
    writer, below = Writer(), "%in1"
    for layer, (fewer, more) in enumerate(itertools.pairwise(sizes)):
        out, weight = f"%out{layer}", writer.at("%in0", places[layer])
        bias = writer.at("%in0", places[count + layer])
        writer.product((more, number, fewer), (weight, 1, more), (below, number), (out, number), bias)
        if squash or layer < count - 1:
            writer.elementwise(elementary.tanh, [out], out, more * number)
        below = out
    return writer.function(name, 2, count)


@functools.cache
def backward_function(
    name: str, sizes: tuple[int, ...], number: int, squash: bool, add: bool = False, below: bool = True
) -> str:
    """In LLVM: parameters, inputs, activations, cotangent -> cotangents of parameters and inputs.

    Three more outputs are room to work in. The cotangents of the parameters may be added to what is there; those of
    the inputs are left out where `below` is False.
    """
    count, places = len(sizes) - 1, _places(sizes)
    writer, given = Writer(), f"%in{2 + count}"
    spare, turned = ["%out2", "%out3"], "%out4"
    for layer in reversed(range(count)):
        fewer, more = sizes[layer : layer + 2]
        if squash or layer < count - 1:
            slope = spare[0]
            writer.elementwise(lambda g, h: g * (1.0 - h * h), [given, f"%in{2 + layer}"], slope, more * number)
            given, spare = slope, spare[::-1]
        source = f"%in{1 + layer}"  # the activations of the layer before, or the inputs
        writer.transpose(given, turned, more, number)
        to = writer.at("%out0", places[layer])
        writer.product((fewer, more, number), (source, number, 1), (turned, more), (to, more), add=add)
        writer.sum_rows(turned, writer.at("%out0", places[count + layer]), number, more, add=add)
        weight, target = writer.at("%in0", places[layer]), spare[0] if layer else "%out1"
        if layer or below:
            writer.product((fewer, number, more), (weight, more, 1), (given, number), (target, number))
        given, spare = target, spare[::-1]
    return writer.function(name, 3 + count, 5)
