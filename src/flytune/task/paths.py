"""Paths in closed form: circle, lemniscate and helix."""

import math
from typing import Annotated, Any, Literal

import jax.numpy as jnp
from annotated_types import Ge, Gt, Le, Unit, doc

from flytune.config.document import Real
from flytune.config.pytree import pytree, static
from flytune.physics.components import Components
from flytune.task.reference import Path

Metres = Annotated[
    Real, Ge(-1000), Le(1000), Unit("m"), doc("positions are single precision, coarser than 0.1 mm farther out")
]
Yaw = Annotated[Real, Ge(-2 * math.pi), Le(2 * math.pi), Unit("rad"), doc("a full turn either way")]
Length = Annotated[Real, Gt(0), Le(1000), Unit("m")]
Speed = Annotated[Real, Gt(0), Le(100), Unit("m/s")]
Facing = Literal["fixed", "along_path"]


@pytree
class Circuit(Path):
    """What circle, lemniscate and helix have in common."""

    centre: tuple[Metres, Metres, Metres] = (0.0, 0.0, 1.0)
    speed: Speed = 0.5
    yaw: Yaw = 0.0  # with facing along_path: from the direction of flight
    facing: Facing = static(default="fixed")  # along_path: the heading turns with the direction of flight

    @property
    def position(self) -> Components:
        """The position at time 0, in m."""
        return self.place(0.0)

    @property
    def first_yaw(self) -> Any:
        """The yaw at time 0, in rad."""
        return self.heading(0.0)

    def direction(self, time: Any, xp: Any) -> Any:
        """The direction of flight in the horizontal plane, in rad."""
        raise NotImplementedError

    def heading(self, time: Any, xp: Any = jnp) -> Any:
        """The yaw in rad at a time in s."""
        if self.facing == "fixed":
            return self.yaw + 0.0 * time
        return self.yaw + self.direction(time, xp)


@pytree
class Circle(Circuit):
    """A horizontal circle at constant speed, anticlockwise seen from above; it begins at +x of its centre."""

    kind: Literal["circle"] = static(default="circle")
    radius: Length = 1.0

    def place(self, time: Any, xp: Any = jnp) -> Components:
        """The position in m at a time in s."""
        angle = self.speed / self.radius * time
        x, y, z = self.centre
        return x + self.radius * xp.cos(angle), y + self.radius * xp.sin(angle), z + 0.0 * angle

    def direction(self, time: Any, xp: Any) -> Any:
        """The direction of flight in rad."""
        return self.speed / self.radius * time + math.pi / 2


@pytree
class Lemniscate(Circuit):
    """A lemniscate of Gerono, a figure of eight in the horizontal plane, which begins in its centre.

        x = half_width sin(theta), y = half_width sin(theta) cos(theta), theta = speed t / (sqrt(2) half_width)

    `speed` is the largest one, at the centre.
    """

    kind: Literal["lemniscate"] = static(default="lemniscate")
    half_width: Length = 1.0  # from the centre to the farthest point on either side

    def place(self, time: Any, xp: Any = jnp) -> Components:
        """The position in m at a time in s."""
        angle = self._angle(time)
        x, y, z = self.centre
        side = self.half_width * xp.sin(angle)
        return x + side, y + side * xp.cos(angle), z + 0.0 * angle

    def direction(self, time: Any, xp: Any) -> Any:
        """The direction of flight in rad."""
        angle = self._angle(time)
        return xp.arctan2(xp.cos(2 * angle), xp.cos(angle))

    def _angle(self, time: Any) -> Any:
        return self.speed / (math.sqrt(2) * self.half_width) * time


@pytree
class Helix(Circuit):
    """A circle that climbs, or sinks, by the same height in each turn; `speed` is along the path."""

    kind: Literal["helix"] = static(default="helix")
    radius: Length = 1.0
    climb_per_turn: Annotated[Real, Ge(-100), Le(100), Unit("m")] = 0.2

    def place(self, time: Any, xp: Any = jnp) -> Components:
        """The position in m at a time in s."""
        angle, rise = self._angle(time)
        x, y, z = self.centre
        return x + self.radius * xp.cos(angle), y + self.radius * xp.sin(angle), z + rise * angle

    def direction(self, time: Any, xp: Any) -> Any:
        """The direction of flight in rad."""
        return self._angle(time)[0] + math.pi / 2

    def _angle(self, time: Any) -> tuple[Any, Any]:
        """The angle flown in rad, and the rise in m per radian."""
        rise = self.climb_per_turn / (2 * math.pi)
        return self.speed / (self.radius * self.radius + rise * rise) ** 0.5 * time, rise
