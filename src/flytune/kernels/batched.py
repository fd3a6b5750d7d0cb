"""A function of one element as a function of a batch: one compiled loop where that is possible, `jax.vmap` elsewhere.

XLA computes a function with many outputs by one loop per output, and computes what the outputs share again in each. A
kernel is one loop that computes all of them, sixteen elements at once. The gradient is another kernel, made from JAX's
own derivative of the function; it keeps the inputs of the function and nothing else.
"""

import functools
import importlib.util
import os
import warnings
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jax.custom_derivatives import SymbolicZero
from jax.extend.core import jaxpr_as_fun
from jaxtyping import Array

from flytune.kernels.emit import Unsupported
from flytune.kernels.native import loop, module, register

LARGEST = 400  # numbers of an array that all elements share; a kernel holds each as a value of its own
SWITCH = "FLYTUNE_KERNELS"  # 0 in the environment switches kernels off

Flat = Sequence[Any]


def available() -> bool:
    """Whether kernels are compiled here: on a CPU, where llvmlite is installed, unless FLYTUNE_KERNELS is 0."""
    wanted = os.environ.get(SWITCH, "1") != "0"
    return wanted and jax.default_backend() == "cpu" and importlib.util.find_spec("llvmlite") is not None


def batched(function: Callable[..., Any], shared: Any = ()) -> Callable[..., Any]:
    """`function(shared, *inputs)` of every element of a batch, as a function of the inputs alone.

    It equals `jax.vmap(partial(function, shared), in_axes=-1, out_axes=-1)` up to rounding, and so do its gradients.

    Args:
        function: of one element, in single precision; it may draw random numbers from keys.
        shared: a pytree, the same for all elements.

    Returns:
        A function of pytrees whose arrays have the batch as their last axis (keys of random numbers: as their only
        axis).
    """
    plain = jax.checkpoint(jax.vmap(functools.partial(function, shared), in_axes=-1, out_axes=-1), prevent_cse=False)
    if not available() or has_table(shared):
        return plain
    prepared = Prepared(function, shared)

    def call(*inputs: Any) -> Any:
        kernel, flat = prepared.kernel(*inputs)
        try:
            outputs: Any = _run(kernel, prepared.packed, flat)
        except Unsupported as error:
            warnings.warn(f"kernels: {error} of JAX has no form as a loop here; this runs as slower JAX.", stacklevel=2)
            return plain(*inputs)
        return jax.tree.unflatten(kernel.form, outputs)

    return call


def has_table(shared: Any) -> bool:
    """Whether an array among what all elements share is so large that one looks values up in it; JAX does that."""
    return any(jnp.size(leaf) > LARGEST for leaf in jax.tree.leaves(shared))


class Prepared:
    """A function of one element and what it shares with the others, whose numbers are packed: `packed`."""

    def __init__(self, function: Callable[..., Any], shared: Any) -> None:
        self._function = function
        self._leaves, self._structure = jax.tree.flatten(shared)
        self.packed = _pack([jnp.asarray(leaf) for leaf in self._leaves])

    def kernel(self, *inputs: Any) -> tuple["Kernel", Flat]:
        """The kernel for inputs of these shapes, and the inputs as it takes them."""
        flat, form = jax.tree.flatten(inputs)
        is_key = [jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key) for leaf in flat]
        flat = [words(leaf) if key else leaf for leaf, key in zip(flat, is_key, strict=True)]

        def one(parts: Flat, values: Flat) -> Any:
            numbers = [
                jax.random.wrap_key_data(leaf) if key else leaf for leaf, key in zip(values, is_key, strict=True)
            ]
            whole = jax.tree.unflatten(self._structure, _unpack(parts, self._leaves))
            return self._function(whole, *jax.tree.unflatten(form, numbers))

        return Kernel(one, self.packed, flat), flat


class Kernel:
    """One function, its loop, and the loops of its gradients."""

    def __init__(self, one: Callable[[Flat, Flat], Any], packed: Flat, flat: Flat) -> None:
        self.number = flat[0].shape[-1]
        self._kinds = [jax.ShapeDtypeStruct(leaf.shape, leaf.dtype) for leaf in packed]
        self._inputs = [jax.ShapeDtypeStruct(leaf.shape[:-1], leaf.dtype) for leaf in flat]
        closed, shape = jax.make_jaxpr(one, return_shape=True)(self._kinds, self._inputs)
        self.form = jax.tree.structure(shape)
        self.jaxpr, self._function = closed, jaxpr_as_fun(closed)

    def __call__(self, packed: Flat, flat: Flat) -> list[Array]:
        """The outputs of every element."""
        return self._loop(self.jaxpr, [*packed, *flat], len(packed))

    def gradient(
        self, packed: Flat, flat: Flat, given: Sequence[Any], wanted: Sequence[bool]
    ) -> tuple[list[Any], list[Any]]:
        """The cotangents of the shared numbers and of the inputs; None of those that are not wanted.

        Args:
            packed: the shared numbers.
            flat: the inputs.
            given: the cotangent of each output, None where it is zero.
            wanted: whether the cotangent of each shared vector, then of each input, is needed.
        """
        variables = [*packed, *flat]
        chosen = [index for index, each in enumerate(wanted) if each]
        known = [index for index, each in enumerate(given) if each is not None]
        closed = self.gradient_jaxpr(chosen, known)
        found: list[Any] = [None] * len(variables)
        outputs = self._loop(closed, [*variables, *(given[index] for index in known)], len(packed))
        for index, output in zip(chosen, outputs, strict=True):
            found[index] = jnp.sum(output, axis=-1) if index < len(packed) else output
        return found[: len(packed)], found[len(packed) :]

    def gradient_jaxpr(self, chosen: Sequence[int], known: Sequence[int]) -> Any:
        """The function of one element: all inputs, cotangents of outputs `known` -> cotangents of inputs `chosen`."""
        kinds = [*self._kinds, *self._inputs]

        def one(values: Flat, cotangents: Flat) -> Any:
            def outputs(part: Flat) -> list[Any]:
                whole = list(values)
                for index, value in zip(chosen, part, strict=True):
                    whole[index] = value
                results = self._function(*whole)
                return [results[index] for index in known]

            return jax.vjp(outputs, [values[index] for index in chosen])[1](list(cotangents))[0]

        results = [self.jaxpr.out_avals[index] for index in known]
        return jax.make_jaxpr(one)(kinds, [jax.ShapeDtypeStruct(kind.shape, kind.dtype) for kind in results])

    def _loop(self, closed: Any, values: Flat, shared: int) -> list[Array]:
        batched = [index >= shared for index in range(len(values))]
        text = loop("loop", closed, batched, self.number)
        name, text = module([text], "loop", len(values), len(closed.out_avals))
        register(name, text)
        outputs = [jax.ShapeDtypeStruct((*kind.shape, self.number), kind.dtype) for kind in closed.out_avals]
        return list(jax.ffi.ffi_call(name, outputs, vmap_method="sequential")(*values))


@functools.partial(jax.custom_vjp, nondiff_argnums=(0,))
def _run(kernel: Kernel, packed: Flat, flat: Flat) -> list[Array]:
    return kernel(packed, flat)


@jax.tree_util.register_static
class _Wanted(tuple[bool, ...]):
    """Which inputs a gradient is wanted of; part of the structure, not of the numbers."""


def _forward(kernel: Kernel, packed: Flat, flat: Flat) -> Any:
    wanted = _Wanted(each.perturbed and each.value.dtype == jnp.float32 for each in (*packed, *flat))
    packed, flat = [each.value for each in packed], [each.value for each in flat]
    return kernel(packed, flat), (packed, flat, wanted)


def _backward(kernel: Kernel, kept: Any, cotangents: Flat) -> Any:
    packed, flat, wanted = kept
    none = [isinstance(each, SymbolicZero) or each.dtype == jax.dtypes.float0 for each in cotangents]
    given = [None if zero else each for each, zero in zip(cotangents, none, strict=True)]
    return kernel.gradient(packed, flat, given, wanted)


_run.defvjp(_forward, _backward, symbolic_zeros=True)


def words(keys: Array) -> Array:
    """Keys of random numbers [..., N] as their words [..., 2, N]."""
    return jnp.swapaxes(jax.random.key_data(keys), -1, -2)


def _pack(leaves: Sequence[Array]) -> list[Array]:
    """The numbers of all leaves as one vector for each type of number."""
    kinds = dict.fromkeys(leaf.dtype for leaf in leaves)
    return [jnp.concatenate([leaf.ravel() for leaf in leaves if leaf.dtype == kind]) for kind in kinds]


def _unpack(vectors: Flat, leaves: Flat) -> list[Any]:
    """The leaves of packed vectors."""
    kinds = list(dict.fromkeys(jnp.asarray(leaf).dtype for leaf in leaves))
    place, result = dict.fromkeys(kinds, 0), []
    for leaf in leaves:
        kind, shape, size = jnp.asarray(leaf).dtype, jnp.shape(leaf), jnp.size(leaf)
        vector = vectors[kinds.index(kind)]
        result.append(vector[place[kind] : place[kind] + size].reshape(shape))
        place[kind] += size
    return result
