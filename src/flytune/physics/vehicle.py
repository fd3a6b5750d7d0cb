"""Vehicles: every constant of a quadrotor, with unit and source, in one TOML file per vehicle."""

import math
from importlib import resources
from pathlib import Path
from typing import Annotated, Any

from annotated_types import Ge, Gt, Le, Unit

from flytune.config import document
from flytune.config.document import Real, Whole
from flytune.config.pytree import label, pytree, static
from flytune.errors import BadInput


@pytree
class Vehicle:
    """A quadrotor in x configuration: mass, geometry, propellers, motors.

    Motors 0 (+x, -y), 1 (-x, -y), 2 (-x, +y), 3 (+x, +y); x forward, y left, z up (paper R4).
    """

    name: str = label(default="custom")
    mass: Annotated[Real, Gt(0), Unit("kg")]
    inertia: tuple[
        Annotated[Real, Gt(0), Unit("kg m^2")],
        Annotated[Real, Gt(0), Unit("kg m^2")],
        Annotated[Real, Gt(0), Unit("kg m^2")],
    ]  # principal moments about x, y, z
    arm: Annotated[Real, Gt(0), Unit("m")]  # from the centre to each motor; the lever is arm / sqrt(2)
    thrust_coefficient: Annotated[Real, Gt(0), Unit("N/rpm^2")]
    torque_coefficient: Annotated[Real, Gt(0), Unit("N m/rpm^2")]
    propeller_radius: Annotated[Real, Gt(0), Unit("m")]
    drag: tuple[
        Annotated[Real, Ge(0), Unit("kg/s")],
        Annotated[Real, Ge(0), Unit("kg/s")],
        Annotated[Real, Ge(0), Unit("kg/s")],
    ]  # linear drag along the inertial axes
    gravity: Annotated[Real, Gt(0), Unit("m/s^2")]
    action_scale: Annotated[Real, Gt(0), Le(1), Unit("1")]  # rotor speed = hover speed * (1 + action_scale * action)
    maximum_rotor_speed_rpm: Annotated[Real, Gt(0), Unit("rpm")]
    motor_rise_time_constant: Annotated[Real, Ge(0), Unit("s")]  # 0: the motor follows at once
    motor_fall_time_constant: Annotated[Real, Ge(0), Unit("s")]
    action_latency_steps: Annotated[Whole, Ge(0), Le(20), Unit("control steps")] = static()
    sources: dict[str, str] = label(default_factory=dict)

    def __repr__(self) -> str:
        return f"Vehicle({self.name}, {self.mass} kg)"

    @property
    def hover_rotor_speed_rpm(self) -> float:
        """The rotor speed at which four propellers carry the weight, sqrt(g m / 4 kf), in rpm (paper R5)."""
        return (self.gravity * self.mass / (4 * self.thrust_coefficient)) ** 0.5

    @property
    def lever(self) -> float:
        """Distance of each motor from the x and from the y axis in metres, arm / sqrt(2) (paper R4)."""
        return self.arm / math.sqrt(2)

    @property
    def thrust_to_weight(self) -> float:
        """Largest thrust the actions can ask for, over the weight."""
        fastest = min(self.hover_rotor_speed_rpm * (1 + self.action_scale), self.maximum_rotor_speed_rpm)
        return (fastest / self.hover_rotor_speed_rpm) ** 2

    def problem(self) -> str | None:
        """What makes the numbers impossible together, or None."""
        if self.maximum_rotor_speed_rpm <= self.hover_rotor_speed_rpm:
            return (
                f"maximum_rotor_speed_rpm: {self.maximum_rotor_speed_rpm} cannot lift the vehicle. "
                f"Allowed: above the hover speed, {self.hover_rotor_speed_rpm:.0f} rpm."
            )
        largest, others = max(self.inertia), sum(self.inertia) - max(self.inertia)
        if largest > others:
            return f"inertia: {list(self.inertia)} is no rigid body's. Allowed: each at most the sum of the other two."
        return None


def vehicle_names() -> list[str]:
    """The vehicles that ship with flytune."""
    folder = resources.files("flytune.physics") / "vehicles"
    return sorted(entry.name.removesuffix(".toml") for entry in folder.iterdir() if entry.name.endswith(".toml"))


def vehicle_table(name: str) -> dict[str, Any]:
    """The plain tables of a shipped vehicle, or of a vehicle file.

    Raises:
        BadInput: neither a shipped vehicle nor a readable file.
    """
    if name in vehicle_names():
        text = resources.files("flytune.physics") / "vehicles" / f"{name}.toml"
        with resources.as_file(text) as path:
            return {"name": name, **document.load(path)}
    if name.endswith(".toml"):
        path = Path(name)
        return {"name": path.stem, **document.load(path)}
    hint = document.nearest(name, vehicle_names())
    raise BadInput(
        f"vehicle: {name!r} is no vehicle. Allowed: {', '.join(vehicle_names())}, or a .toml file."
        + (f" Did you mean {hint}?" if hint else "")
    )


def load_vehicle(name: str) -> Vehicle:
    """A vehicle by its name or file.

    Raises:
        BadInput: unknown, unreadable, or with values out of range.
    """
    return document.read(Vehicle, vehicle_table(name), where=name)
