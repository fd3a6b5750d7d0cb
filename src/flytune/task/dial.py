"""Dials: numbers that a controller is told, and that fields of its task follow. One policy then has many responses."""

import math
from collections.abc import Mapping
from typing import Annotated, Any, Literal, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from annotated_types import Ge, Le, Unit
from jaxtyping import Array, Float

from flytune.config import document
from flytune.config.document import Real
from flytune.config.formula import Formula
from flytune.config.pytree import label, pytree, static
from flytune.errors import BadInput
from flytune.task.observation import BLOCK_NAMES, BLOCKS

T = TypeVar("T")
Setting = Mapping[str, Any]  # dial -> its value
TOLERANCE = 1e-6  # share of a range, by which rounding may exceed it


@pytree
class Dial:
    """A number that may be set at any time, also in flight. In training it is drawn at random for each episode."""

    lowest: Annotated[Real, Unit("in its unit")]
    highest: Annotated[Real, Unit("in its unit")]
    default: Annotated[Real, Unit("in its unit")]
    spacing: Literal["linear", "logarithmic"] = static(default="linear")  # drawn evenly in the value or its logarithm
    turned: Annotated[Real, Ge(0), Le(1), Unit("1")] = 0.0  # share of the episodes in which each update turns it
    trained_beyond: Annotated[Real, Ge(0), Le(1), Unit("share of the range")] = 0.0  # training also draws past the ends
    sweep_time: Annotated[Real, Ge(0), Unit("s")] = 0.0  # in flight, a turn over the whole range takes this long
    unit: str = label(default="")
    meaning: str = label(default="")

    def problem(self) -> str | None:
        """What makes the numbers impossible together, or None."""
        if not self.lowest < self.highest:
            return f"lowest: {self.lowest} is not below highest. Allowed: below {self.highest}."
        if not self.lowest <= self.default <= self.highest:
            return f"default: {self.default} is out of range. Allowed: {self.lowest} to {self.highest}."
        if self.spacing == "logarithmic" and self.lowest <= 0:
            return f"lowest: {self.lowest} has no logarithm. Allowed: above 0, or spacing linear."
        return None

    def at(self, share: Any) -> Any:
        """The value at a share of the range, from 0 at `lowest` to 1 at `highest`, by the spacing; of any arrays."""
        xp: Any = jnp if isinstance(share, jax.Array) else math
        if self.spacing == "linear":
            return self.lowest + (self.highest - self.lowest) * share
        return self.lowest * xp.exp(xp.log(self.highest / self.lowest) * share)

    def share(self, value: Any) -> Any:
        """The share of the range at which a value lies, the inverse of `at`; of any arrays."""
        xp: Any = jnp if isinstance(value, jax.Array) else math
        if self.spacing == "linear":
            return (value - self.lowest) / (self.highest - self.lowest)
        return xp.log(value / self.lowest) / xp.log(self.highest / self.lowest)

    def draw(self, key: jax.Array) -> jax.Array:
        """A random value of a training episode, even in the spacing; up to `trained_beyond` past the ends."""
        beyond = self.trained_beyond
        return self.at((1 + 2 * beyond) * jax.random.uniform(key, ()) - beyond)

    def grid(self, number: int) -> list[float]:
        """Values from `lowest` to `highest`, both included, even in the spacing."""
        inner = [float(self.at(index / (number - 1))) for index in range(1, number - 1)]
        return [float(self.lowest), *inner, float(self.highest)]

    def trained_grid(self, number: int) -> list[float]:
        """The grid of so many values, and the ends of what training draws."""
        if not self.trained_beyond:
            return self.grid(number)
        return [float(self.at(-self.trained_beyond)), *self.grid(number), float(self.at(1 + self.trained_beyond))]


@pytree
class Input:
    """Something that the controller is told beside its observation.

    It is the value of a formula of the dials; or, with `of`, a block of the observation times this value.
    """

    of: Literal["none", "position_error", "attitude_error", "velocity", "body_rate", "last_action"] = static(
        default="none"
    )
    value: Formula = static()

    @property
    def size(self) -> int:
        """The number of inputs of a network that it makes."""
        return BLOCKS[BLOCK_NAMES.index(self.of)] if self.of in BLOCK_NAMES else 1

    def rows(self) -> slice | None:
        """The place of the block in the observation, None without one."""
        if self.of not in BLOCK_NAMES:
            return None
        first = sum(BLOCKS[: BLOCK_NAMES.index(self.of)])
        return slice(first, first + self.size)


def told(
    inputs: Mapping[str, Input], observation: Float[Array, "*batch 17"], setting: Setting
) -> Float[Array, "*batch _"]:
    """The observation, and behind it all further inputs in the order of their names."""
    parts = [observation]
    for name in sorted(inputs):
        value, rows = jnp.asarray(inputs[name].value.value(setting), observation.dtype)[..., None], inputs[name].rows()
        parts.append(value * (jnp.ones_like(observation[..., :1]) if rows is None else observation[..., rows]))
    return jnp.concatenate(parts, axis=-1) if inputs else observation


def number_of_inputs(inputs: Mapping[str, Input]) -> int:
    """How many numbers `told` puts behind the observation."""
    return sum(each.size for each in inputs.values())


def read_named(kind: type[T], data: Any, where: str) -> dict[str, T]:
    """The dials or inputs of the header of a file, by their names.

    Raises:
        BadInput: they are damaged; the message begins with `where`.
    """
    if not isinstance(data, dict) or not all(isinstance(each, dict) for each in data.values()):
        raise BadInput(f"{where}: is damaged. Allowed: one table for each name.")
    return {name: document.read(kind, each, f"{where}.{name}") for name, each in data.items()}


def checked_setting(dials: Mapping[str, Dial], setting: Setting, where: str = "dial") -> dict[str, float]:
    """The value of every dial: as set, else its default.

    Raises:
        BadInput: an unknown dial, or a value that is no number or out of range.
    """
    values = {name: float(dial.default) for name, dial in dials.items()}
    for name, value in setting.items():
        if name not in dials:
            allowed = f"Allowed: {', '.join(dials)}" if dials else "This one has no dial"
            hint = document.nearest(name, dials)
            raise BadInput(f"{where}: {name!r} is no dial here. {allowed}.{f' Did you mean {hint}?' if hint else ''}")
        dial, number = dials[name], as_number(value)
        room = TOLERANCE * abs(dial.highest - dial.lowest)
        if number is None or not dial.lowest - room <= number <= dial.highest + room:
            unit = f" {dial.unit}" if dial.unit else ""
            raise BadInput(
                f"{where}: {name}={value} is not allowed. Allowed: {dial.lowest:g} to {dial.highest:g}{unit}."
            )
        values[name] = min(max(number, float(dial.lowest)), float(dial.highest))
    return values


def as_number(value: Any) -> float | None:
    """A number of Python, NumPy or JAX as a float; None of anything else, also of text, a truth value and an array."""
    kind = getattr(getattr(value, "dtype", None), "kind", "f" if type(value) in (int, float) else "")
    return float(value) if kind in ("f", "i", "u") and np.ndim(value) == 0 else None
