"""Distributions of initial states: where a training episode or a trial begins (paper R15, R19)."""

import math
from typing import Annotated

import jax
from annotated_types import Ge, Le, Unit

from flytune.config.document import Real
from flytune.config.pytree import pytree
from flytune.physics import rotation
from flytune.physics.dynamics import State, hovering
from flytune.physics.vehicle import Vehicle

Metres = Annotated[Real, Unit("m")]


@pytree
class InitialState:
    """Uniform in a box and in attitude, at rest, rotors at hover speed."""

    lowest_position: tuple[Metres, Metres, Metres]
    highest_position: tuple[Metres, Metres, Metres]
    largest_tilt: Annotated[Real, Ge(0), Le(math.pi / 2), Unit("rad")]  # of roll and of pitch
    largest_yaw: Annotated[Real, Ge(0), Le(math.pi), Unit("rad")]

    def problem(self) -> str | None:
        """What makes the numbers impossible together, or None."""
        for axis, low, high in zip("xyz", self.lowest_position, self.highest_position, strict=True):
            if low > high:
                return f"lowest_position: {low} in {axis} lies above highest_position, {high}. Allowed: {high} or less."
        return None

    def draw(self, vehicle: Vehicle, key: jax.Array) -> State:
        """One state of the distribution."""
        unit = jax.random.uniform(key, (6,))
        box = zip(self.lowest_position, self.highest_position, unit[:3], strict=True)
        position = tuple(low + (high - low) * share for low, high, share in box)
        roll, pitch = (self.largest_tilt * (2 * share - 1) for share in unit[3:5])
        yaw = self.largest_yaw * (2 * unit[5] - 1)
        return hovering(vehicle, position, rotation.from_euler(roll, pitch, yaw))


EVALUATION_INITIAL_STATES = {
    # paper R19 as printed; 5 % of these start below the altitude bound of R14 (C3)
    "paper": InitialState(
        lowest_position=(-2.0, -2.0, 0.0),
        highest_position=(2.0, 2.0, 2.0),
        largest_tilt=math.radians(15),
        largest_yaw=math.pi,
    ),
    # the same without the starts that are already terminated
    "clear": InitialState(
        lowest_position=(-2.0, -2.0, 0.1),
        highest_position=(2.0, 2.0, 2.0),
        largest_tilt=math.radians(15),
        largest_yaw=math.pi,
    ),
}
