"""One step of an optimiser, and the averaging of weights, for every trainer."""

from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array

T = TypeVar("T")


def descend(optimiser: optax.GradientTransformation, gradient: T, memory: Any, parameters: T) -> tuple[T, Any]:
    """Parameters and the optimiser's memory after one step against the gradient."""
    # optax's type of parameters knows arrays and containers, not dataclasses that are pytrees
    change, memory = optimiser.update(gradient, memory, parameters)  # pyright: ignore[reportArgumentType]
    return optax.apply_updates(parameters, change), memory  # pyright: ignore[reportArgumentType, reportReturnType]


def averaged(ema: T, newest: T, keep: float, updates: Array) -> T:
    """The moving average of weights: a plain mean over the first updates, then `keep` of the old per update."""
    share = jnp.minimum(keep, updates / (updates + 1.0))
    return jax.tree.map(lambda old, new: share * old + (1 - share) * new, ema, newest)
