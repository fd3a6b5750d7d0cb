"""Vehicles: every constant of a quadrotor, with unit and source, in one TOML file per vehicle."""

import math
import os
from importlib import resources
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from annotated_types import Ge, Gt, Le, Unit, doc

from flytune.config import document
from flytune.config.document import Real, Whole
from flytune.config.pytree import label, pytree, static
from flytune.errors import BadInput
from flytune.physics.plausibility import implausible

Place = tuple[Annotated[Real, Unit("m")], Annotated[Real, Unit("m")]]
Spin = Literal[-1, 1]
NotNegative = Annotated[Real, Ge(0)]
MotorLag = Annotated[Real, Ge(0), Le(1), Unit("s"), doc("motors of quadrotors need 0.005 to 0.3 s")]


@pytree
class Rotors:
    """A layout of four rotors other than the x configuration; x forward, y left, the origin at the centre of mass.

    Four equal thrusts have to carry the vehicle without turning it, so that action 0 hovers (paper R5, R9).
    """

    place: tuple[Place, Place, Place, Place]  # x and y of each rotor
    spin: tuple[Spin, Spin, Spin, Spin] = static()  # sign of the torque about z: 1 where the propeller turns clockwise

    def problem(self) -> str | None:
        """What makes the layout impossible, or None."""
        place = np.array(self.place, float)
        largest = np.linalg.norm(place, axis=1).max()
        x, y = (float(part) for part in place.mean(axis=0))
        if np.hypot(x, y) > 1e-6 * largest or largest == 0:
            return f"place: the middle of the rotors, ({x:g}, {y:g}), is not (0, 0). Allowed: places whose mean is 0."
        if sum(self.spin) != 0:
            return f"spin: {list(self.spin)} turns the vehicle at hover. Allowed: two of 1 and two of -1."
        # how the rotors have to differ to give yaw torque alone: the differences of place that cancel
        alone = np.array(
            [np.linalg.det(np.delete(np.c_[np.ones(4), place / largest], i, 0)) * (-1) ** i for i in range(4)]
        )
        if np.abs(alone).min() < 1e-3:
            return "place: three rotors stand on one line. Allowed: no three on a line."
        if abs(alone @ np.array(self.spin)) < 1e-3:
            return "spin: yaw torque cannot be given alone. Allowed: neighbours that spin in opposite directions."
        return None


@pytree
class Vehicle:
    """A quadrotor: mass, geometry, propellers, motors.

    Without `rotors` the motors stand in x configuration: 0 (+x, -y), 1 (-x, -y), 2 (-x, +y), 3 (+x, +y), each `arm`
    from the centre; x forward, y left, z up (paper R4).
    """

    name: str = label(default="custom")
    mass: Annotated[Real, Gt(0), Unit("kg")]
    inertia: tuple[
        Annotated[Real, Gt(0), Unit("kg m^2")],
        Annotated[Real, Gt(0), Unit("kg m^2")],
        Annotated[Real, Gt(0), Unit("kg m^2")],
    ]  # principal moments about x, y, z
    arm: Annotated[  # x configuration
        Real | None,
        Gt(0),
        Unit("m"),
        doc("from the centre of mass to each motor, half of a diagonal from motor to motor"),
    ] = None
    rotors: Rotors | None = None  # another layout, in place of `arm`
    thrust_coefficient: Annotated[Real, Gt(0), Unit("N/rpm^2")]
    torque_coefficient: Annotated[Real, Gt(0), Unit("N m/rpm^2")]
    propeller_radius: Annotated[Real, Gt(0), Unit("m")]
    drag: tuple[
        Annotated[Real, Ge(0), Unit("kg/s")],
        Annotated[Real, Ge(0), Unit("kg/s")],
        Annotated[Real, Ge(0), Unit("kg/s")],
    ]  # linear drag along the inertial axes
    rotor_drag: Annotated[  # of turning propellers, along the body's axes, per sum of rotor speeds; for PyBullet
        tuple[NotNegative, NotNegative, NotNegative] | None, Unit("kg/rad")
    ] = None
    ground_effect: Annotated[Real | None, Ge(0), Le(100), Unit("1")] = None  # k of the gain k (r / 4 h)^2; for PyBullet
    gravity: Annotated[Real, Ge(1), Le(30), Unit("m/s^2"), doc("the Moon has 1.6, the Earth 9.8, Jupiter 25")]
    action_scale: Annotated[  # rotor speed = hover speed * (1 + action_scale * action), never below 0
        Real, Gt(0), Le(3), Unit("1"), doc("at 3, full action gives 16 times the weight; quadrotors reach 12")
    ]
    maximum_rotor_speed_rpm: Annotated[Real, Gt(0), Unit("rpm")]
    motor_rise_time_constant: MotorLag  # 0: the motor follows at once
    motor_fall_time_constant: MotorLag
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
        """Distance of each motor from the x and from the y axis in metres, arm / sqrt(2) (paper R4).

        Raises:
            ValueError: the vehicle gives its rotors' places instead of an arm.
        """
        if self.arm is None:
            raise ValueError("a vehicle with [rotors] has no single lever")
        return self.arm / math.sqrt(2)

    @property
    def thrust_to_weight(self) -> float:
        """Largest thrust the actions can ask for, over the weight."""
        fastest = min(self.hover_rotor_speed_rpm * (1 + self.action_scale), self.maximum_rotor_speed_rpm)
        return (fastest / self.hover_rotor_speed_rpm) ** 2

    def problem(self) -> str | None:
        """What makes the numbers impossible together, or None."""
        if self.arm is None and self.rotors is None:
            return "arm: missing. Allowed: above 0 m, or a table [rotors] with the place and spin of each rotor."
        if self.arm is not None and self.rotors is not None:
            return 'arm: stands beside [rotors], which say where the rotors are. Give one, and "none" for the other.'
        if text := implausible(self):
            return text
        largest, others = max(self.inertia), sum(self.inertia) - max(self.inertia)
        if largest > others:
            return f"inertia: {list(self.inertia)} is no rigid body's. Allowed: each at most the sum of the other two."
        return None


def vehicle_names() -> list[str]:
    """The vehicles that ship with flytune."""
    folder = resources.files("flytune.physics") / "vehicles"
    return sorted(entry.name.removesuffix(".toml") for entry in folder.iterdir() if entry.name.endswith(".toml"))


def vehicle_table(name: str, folder: Path = Path(), where: str = "") -> dict[str, Any]:
    """The plain tables of a shipped vehicle, or of a vehicle file.

    Args:
        name: of the vehicle, or the path of its file.
        folder: what a relative path starts from.
        where: the beginning of a message, for instance the file that names the vehicle.

    Raises:
        BadInput: neither a shipped vehicle nor a readable file.
    """
    if name in vehicle_names():
        text = resources.files("flytune.physics") / "vehicles" / f"{name}.toml"
        with resources.as_file(text) as path:
            return {"name": name, **document.load(path)}
    if name.endswith(".toml"):
        path = folder / Path(name).expanduser()
        beside = " A path in a file is relative to the folder of that file." if where else ""
        return {"name": path.stem, **document.load(path, f"{where}vehicle: ", f"Give a vehicle's file.{beside}")}
    file = f"{name}.toml"
    hint = file if os.path.isfile(folder / file) else document.nearest(name, vehicle_names())
    raise BadInput(
        f"{where}vehicle: {name!r} is no vehicle. Allowed: {', '.join(vehicle_names())}, or a .toml file."
        + (f" Did you mean {hint}?" if hint else "")
    )


def load_vehicle(name: str) -> Vehicle:
    """A vehicle by its name or file.

    Raises:
        BadInput: unknown, unreadable, or with values out of range.
    """
    return document.read(Vehicle, vehicle_table(name), where=name)
