"""Distributions of initial states: where a training episode or a trial begins (paper R15, R19)."""

import math
from typing import Annotated, Any

import jax
import jax.numpy as jnp
from annotated_types import Ge, Le, Unit

from flytune.config.document import Real
from flytune.config.pytree import pytree
from flytune.physics import rotation
from flytune.physics.components import Components
from flytune.physics.dynamics import State, hovering
from flytune.physics.rotation import safe_norm
from flytune.physics.vehicle import Vehicle
from flytune.task.paths import Metres
from flytune.task.target import Target


@pytree
class InitialState:
    """Uniform in a box around the target and in attitude, at rest, rotors at hover speed.

    The box is relative to the target: it is written for a target at `for_target` and moves with the task's own, but no
    start lies below `lowest_altitude`. The heading is relative to that of the target; the box does not turn with it.
    Of a target that moves, place and heading at the start count.
    """

    lowest_position: tuple[Metres, Metres, Metres]  # corner of the box for a target at for_target
    highest_position: tuple[Metres, Metres, Metres]  # the opposite corner
    for_target: tuple[Metres, Metres, Metres] = (0.0, 0.0, 1.0)  # paper R19; with [0, 0, 0], corners are offsets
    lowest_altitude: Metres = 0.0  # of a start; the box is cut off below
    largest_tilt: Annotated[Real, Ge(0), Le(math.pi), Unit("rad")]  # of roll and of pitch
    largest_yaw: Annotated[Real, Ge(0), Le(math.pi), Unit("rad")]  # from the heading of the target

    def problem(self) -> str | None:
        """What makes the numbers impossible together, or None."""
        for axis, low, high in zip("xyz", self.lowest_position, self.highest_position, strict=True):
            if low > high:
                return f"lowest_position: {low} in {axis} lies above highest_position, {high}. Allowed: {high} or less."
        return None

    def problem_around(self, target: Target) -> str | None:
        """What leaves no start around a target, or None."""
        highest = float(self.highest_position[2] + self.moved(target)[2])
        if highest >= self.lowest_altitude:
            return None
        return (
            f"lowest_altitude: {float(self.lowest_altitude):g} m lies above all starts, whose box ends at {highest:g} "
            f"m for a target at {float(target.position[2]):g} m. Give a lower one, or a higher target."
        )

    def moved(self, target: Target) -> Components:
        """How far the box of a target lies from the box as it is written, in m."""
        return tuple(here - there for here, there in zip(target.position, self.for_target, strict=True))

    def farthest(self) -> Any:
        """The largest distance of a start from the target in m."""
        ends = zip(self.lowest_position, self.highest_position, self.for_target, strict=True)
        sides = (jnp.maximum(jnp.abs(low - middle), jnp.abs(high - middle)) for low, high, middle in ends)
        return safe_norm(tuple(sides))

    def draw(self, vehicle: Vehicle, target: Target, key: jax.Array) -> State:
        """One state of the distribution around a target."""
        unit = jax.random.uniform(key, (6,))
        box = zip(self.lowest_position, self.highest_position, unit[:3], self.moved(target), strict=True)
        x, y, z = (low + (high - low) * share + moved for low, high, share, moved in box)
        bottom, top = (each[2] + self.moved(target)[2] for each in (self.lowest_position, self.highest_position))
        above = self.lowest_altitude + (top - self.lowest_altitude) * unit[2]
        position = x, y, jnp.where(bottom < self.lowest_altitude, above, z)
        roll, pitch = (self.largest_tilt * (2 * share - 1) for share in unit[3:5])
        yaw = target.first_yaw + self.largest_yaw * (2 * unit[5] - 1)
        return hovering(vehicle, position, rotation.from_euler(roll, pitch, yaw))


EVALUATION_INITIAL_STATES = {
    # paper R19 as printed; 5 % of these start below the altitude bound of R14 (C3)
    "paper": InitialState(
        lowest_position=(-2.0, -2.0, 0.0),
        highest_position=(2.0, 2.0, 2.0),
        largest_tilt=math.radians(15),
        largest_yaw=math.pi,
    ),
    # the same without the starts that are already terminated: at least 0.1 m high, wherever the target is
    "clear": InitialState(
        lowest_position=(-2.0, -2.0, 0.0),
        lowest_altitude=0.1,
        highest_position=(2.0, 2.0, 2.0),
        largest_tilt=math.radians(15),
        largest_yaw=math.pi,
    ),
}
