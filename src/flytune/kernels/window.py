"""A rollout over a whole window as one kernel, and its gradient as another.

At every step of the window, `look` gives an observation, a perceptron the action, and `move` the next episodes and what
is recorded. What the gradient needs is written where the gradient reads it. In a loop of XLA it would be copied twice,
which takes a third of the time.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array, Float, UInt32

from flytune.kernels.batched import Kernel, Prepared, has_table, words
from flytune.kernels.dense import Actor, backward_function, forward_function, parameters_of
from flytune.kernels.emit import Unsupported
from flytune.kernels.native import loop, module, register
from flytune.kernels.writer import Writer


def window(
    look: Callable[..., Any],
    move: Callable[..., Any],
    shared: Any,
    actor: Actor,
    episodes: Array,
    noise: Any,
    keys: Any,
) -> tuple[Array, Array]:
    """The episodes [K, N] after a window, and what was recorded [T, R, N].

    Gradients exist with respect to the actor and the episodes.

    Args:
        look: (shared, episode [K], key) -> observation [I], of one element.
        move: (shared, episode [K], action [O], key, None) -> episode [K], whether it is over, record [R].
        shared: a pytree, the same for all elements.
        actor: gives the action of an observation.
        episodes: [K, N] at the start.
        noise: keys [T, N] for `look`.
        keys: [T, N] for `move`.

    Raises:
        Unsupported: a primitive of `look` or `move` has no form as a loop.
        NotImplementedError: a gradient with respect to `shared` is asked for.
    """
    if has_table(shared):
        raise Unsupported("a look-up in a table")
    action = jnp.zeros((actor.sizes[-1], episodes.shape[-1]))
    seeing, moving = Prepared(look, shared), Prepared(move, shared)
    spec = _Spec(
        look=seeing.kernel(episodes, noise[0])[0],
        move=moving.kernel(episodes, action, keys[0], None)[0],
        shared=len(seeing.packed),
        sizes=actor.sizes,
        squash=actor.squash,
        steps=len(keys),
    )
    return _window(spec, seeing.packed, actor.parameters, episodes, words(noise), words(keys))


@dataclasses.dataclass(frozen=True, eq=False)
class _Spec:
    """What the two kernels of a window are made from."""

    look: Kernel
    move: Kernel
    shared: int  # vectors of numbers that all elements share
    sizes: tuple[int, ...]
    squash: bool
    steps: int

    @property
    def number(self) -> int:
        return self.look.number

    @property
    def widths(self) -> tuple[int, int]:
        """The numbers of an episode, and of what is recorded of a step."""
        return tuple(self.move.jaxpr.out_avals[index].shape[0] for index in (0, 2))

    def batched(self, inputs: int) -> list[bool]:
        return [index >= self.shared for index in range(self.shared + inputs)]


@functools.partial(jax.custom_vjp, nondiff_argnums=(0,))
def _window(
    spec: _Spec,
    shared: list[Array],
    parameters: Float[Array, "P"],
    episodes: Float[Array, "K N"],
    noise: UInt32[Array, "T 2 N"],
    keys: UInt32[Array, "T 2 N"],
) -> tuple[Array, Array]:
    final, record, *_ = _fly(spec, shared, parameters, episodes, noise, keys)
    return final, record


def _fly(spec: _Spec, shared: list[Array], parameters: Array, episodes: Array, noise: Array, keys: Array) -> Any:
    """The episodes at the end, the record, the episodes at every step and the activations of every layer."""
    (width, recorded), steps, number = spec.widths, spec.steps, spec.number
    outputs = [
        jax.ShapeDtypeStruct((steps, recorded, number), jnp.float32),
        jax.ShapeDtypeStruct((steps + 1, width, number), jnp.float32),
        *(jax.ShapeDtypeStruct((steps, size, number), jnp.float32) for size in spec.sizes),
        jax.ShapeDtypeStruct((number,), jnp.bool_),
    ]
    inputs = [*shared, parameters, episodes, noise, keys]
    record, along, *activations, _ = _call(_forward_functions(spec), inputs, outputs)
    return along[-1], record, along, activations


def _forward(spec: _Spec, shared: Any, parameters: Any, episodes: Any, noise: Any, keys: Any) -> Any:
    if any(each.perturbed for each in shared):
        raise NotImplementedError("kernels: a window with an Actor has no gradient with respect to its task.")
    given = [each.value for each in shared], *(each.value for each in (parameters, episodes, noise, keys))
    final, record, along, activations = _fly(spec, *given)
    return (final, record), (given, along, activations)


def _backward(spec: _Spec, kept: Any, cotangents: Any) -> Any:
    (shared, parameters, _, noise, keys), along, activations = kept
    final, record = (jnp.zeros(each.shape) if isinstance(each, SymbolicZero) else each for each in cotangents)
    (width, _), sizes, number = spec.widths, spec.sizes, spec.number
    shapes = [
        (parameters.size,), (width, number), (width, number), (width, number),
        (sizes[-1], number), (sizes[0], number), *[(max(sizes), number)] * 3,
    ]  # fmt: skip
    outputs = [jax.ShapeDtypeStruct(shape, jnp.float32) for shape in shapes]
    inputs = [*shared, parameters, noise, keys, along, *activations, final, record]
    gradient, start, *_ = _call(_backward_functions(spec), inputs, outputs)
    return None, gradient, start, None, None


_window.defvjp(_forward, _backward, symbolic_zeros=True)


def _call(functions: list[str], inputs: list[Array], outputs: list[Any]) -> list[Array]:
    name, text = module(functions, "window", len(inputs), len(outputs))
    register(name, text)
    return list(jax.ffi.ffi_call(name, outputs, vmap_method="sequential")(*inputs))


def _forward_functions(spec: _Spec) -> list[str]:
    """In LLVM: shared, parameters, episodes, noise, keys -> record, episodes at every step, activations, over."""
    (width, recorded), sizes, number, shared = spec.widths, spec.sizes, spec.number, spec.shared
    common = [f"%in{index}" for index in range(shared)]
    parameters, episodes, noise, keys = (f"%in{shared + index}" for index in range(4))
    record, along, *layers, over = (f"%out{index}" for index in range(len(sizes) + 3))
    writer = Writer()

    def at(base: str, t: str, size: int) -> str:
        return writer.at(base, writer.times(t, size * number))

    def step(t: str) -> None:
        here, following = at(along, t, width), writer.at(along, writer.times(t, width * number, width * number))
        inner = [at(layer, t, size) for layer, size in zip(layers, sizes, strict=True)]
        writer.call("look", *common, here, at(noise, t, 2), inner[0])
        writer.call("dense", parameters, *inner)
        writer.call("move", *common, here, inner[-1], at(keys, t, 2), following, over, at(record, t, recorded))

    writer.copy(episodes, along, width * number)
    writer.each(spec.steps, step)
    return [
        loop("look", spec.look.jaxpr, spec.batched(2), number),
        forward_function("dense", sizes, number, spec.squash),
        loop("move", spec.move.jaxpr, spec.batched(3), number),
        writer.function("window", shared + 4, len(sizes) + 3),
    ]


def _backward_functions(spec: _Spec) -> list[str]:
    """In LLVM: shared, parameters, noise, keys, episodes at every step, activations, cotangents of the episodes at the
    end and of the record -> cotangents of the parameters and of the episodes at the start, and room to work in.
    """
    (width, recorded), sizes, number, shared = spec.widths, spec.sizes, spec.number, spec.shared
    common = [f"%in{index}" for index in range(shared)]
    given = [f"%in{index}" for index in range(shared, shared + 6 + len(sizes))]
    parameters, noise, keys, along, *layers, final, record = given
    gradient, carried, moved, seen, action, inputs, *room = (f"%out{index}" for index in range(9))
    writer = Writer()

    def step(t: str) -> None:
        def at(base: str, size: int) -> str:
            return writer.at(base, writer.times(t, -size * number, (spec.steps - 1) * size * number))

        here, inner = at(along, width), [at(layer, size) for layer, size in zip(layers, sizes, strict=True)]
        writer.call("move", *common, here, inner[-1], at(keys, 2), carried, at(record, recorded), moved, action)
        writer.call("dense", parameters, *inner, action, gradient, inputs, *room)
        writer.call("look", *common, here, at(noise, 2), inputs, seen)
        writer.elementwise(lambda a, b: a + b, [moved, seen], carried, width * number)

    writer.copy(None, gradient, parameters_of(sizes))
    writer.copy(final, carried, width * number)
    writer.each(spec.steps, step)
    look = spec.look.gradient_jaxpr([shared], [0])
    move = spec.move.gradient_jaxpr([shared, shared + 1], [0, 2])
    return [
        loop("look", look, spec.batched(3), number),
        backward_function("dense", sizes, number, spec.squash, add=True),
        loop("move", move, spec.batched(5), number),
        writer.function("window", shared + 6 + len(sizes), 9),
    ]
