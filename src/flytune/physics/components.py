"""Small vectors as tuples of scalars, so that batched physics runs as a few wide loops.

XLA turns arithmetic on scalars (one lane per vehicle under `vmap`) into vectorised loops, but a gradient through
slices and stacks of length-3 arrays into chains of pads and copies, up to twice as slow (docs/concepts/integrator.md).
`unpack` and `pack` convert between arrays and scalars; each is the transpose of the other.
"""

from typing import Any

import jax
import jax.numpy as jnp

Components = tuple[Any, ...]


def _slices(vector: jax.Array) -> Components:
    return tuple(vector[index] for index in range(vector.shape[0]))


def _select(components: Components) -> jax.Array:
    row = jnp.arange(len(components))
    result = jnp.broadcast_to(components[-1], row.shape)
    for index in range(len(components) - 2, -1, -1):
        result = jnp.where(row == index, components[index], result)
    return result


@jax.custom_vjp
def unpack(vector: jax.Array) -> Components:
    """The components of a vector [n] as n scalars."""
    return _slices(vector)


@jax.custom_vjp
def pack(components: Components) -> jax.Array:
    """The vector [n] of n scalars."""
    return _select(components)


unpack.defvjp(lambda vector: (_slices(vector), None), lambda _, gradient: (_select(gradient),))
pack.defvjp(lambda components: (_select(components), None), lambda _, gradient: (_slices(gradient),))


def add(*vectors: Components) -> Components:
    """The sum of vectors."""
    return tuple(sum(parts[1:], start=parts[0]) for parts in zip(*vectors, strict=True))


def scale(factor: Any, vector: Components) -> Components:
    """The vector times a scalar."""
    return tuple(factor * part for part in vector)


def cross(first: Components, second: Components) -> Components:
    """The cross product of two vectors of three."""
    a, b, c = first
    d, e, f = second
    return b * f - c * e, c * d - a * f, a * e - b * d


def squared_norm(vector: Components) -> Any:
    """The squared Euclidean norm."""
    return sum(part * part for part in vector[1:]) + vector[0] * vector[0]
