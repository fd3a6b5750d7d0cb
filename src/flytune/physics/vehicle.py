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
LinearDrag = Annotated[Real, Ge(0), Unit("kg/s")]
QuadraticDrag = Annotated[Real, Ge(0), Unit("kg/m")]
ActionConvention = Literal["hover_relative", "rotor_speed", "thrust"]


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
    ]  # Ixx, Iyy, Izz about the centre of mass
    products_of_inertia: (
        tuple[
            Annotated[Real, Unit("kg m^2")],
            Annotated[Real, Unit("kg m^2")],
            Annotated[Real, Unit("kg m^2")],
        ]
        | None
    ) = None  # Ixy, Ixz, Iyz, as they stand in the matrix of inertia; 0 where missing
    arm: Annotated[  # x configuration
        Real | None,
        Gt(0),
        Unit("m"),
        doc("from the centre of mass to each motor, half of a diagonal from motor to motor"),
    ] = None
    rotors: Rotors | None = None  # another layout, in place of `arm`
    thrust_coefficient: Annotated[Real, Gt(0), Unit("N/rpm^2")]
    thrust_linear: Annotated[Real | None, Unit("N/rpm")] = None  # thrust = thrust_coefficient n^2 + thrust_linear n
    torque_coefficient: Annotated[Real, Gt(0), Unit("N m/rpm^2")]
    torque_linear: Annotated[Real | None, Unit("N m/rpm")] = None  # likewise of the drag torque of a rotor
    propeller_radius: Annotated[Real, Gt(0), Unit("m")]
    drag: tuple[LinearDrag, LinearDrag, LinearDrag]  # linear drag along the inertial axes
    body_drag: tuple[LinearDrag, LinearDrag, LinearDrag] | None = None  # linear drag along the body's axes
    quadratic_drag: tuple[QuadraticDrag, QuadraticDrag, QuadraticDrag] | None = None  # times |v| v, body's axes
    rotor_drag: Annotated[  # of turning propellers, along the body's axes, per sum of rotor speeds
        tuple[NotNegative, NotNegative, NotNegative] | None, Unit("kg/rad")
    ] = None
    optional_rotor_drag: Annotated[  # the same, only where PyBullet is asked for it (rotor_drag=true)
        tuple[NotNegative, NotNegative, NotNegative] | None, Unit("kg/rad")
    ] = None
    ground_effect: Annotated[Real | None, Ge(0), Le(100), Unit("1")] = None  # k of the gain k (r / 4 h)^2; for PyBullet
    gravity: Annotated[Real, Ge(1), Le(30), Unit("m/s^2"), doc("the Moon has 1.6, the Earth 9.8, Jupiter 25")]
    # what an action means: hover_relative, rotor speed = hover speed * (1 + action_scale * action) (paper R9);
    # rotor_speed and thrust, linear from the least at -1 to the largest at 1
    action_convention: ActionConvention = static(default="hover_relative")
    action_scale: Annotated[  # of hover_relative alone
        Real | None, Gt(0), Le(3), Unit("1"), doc("at 3, full action gives 16 times the weight; quadrotors reach 12")
    ] = None
    minimum_rotor_speed_rpm: Annotated[Real, Ge(0), Unit("rpm")] = 0.0
    maximum_rotor_speed_rpm: Annotated[Real | None, Gt(0), Unit("rpm")] = None
    thrust_to_weight: Annotated[Real | None, Ge(1.02), Le(25), Unit("1")] = None  # in place of the maximum rotor speed
    motor_rise_time_constant: MotorLag  # 0: the motor follows at once
    motor_fall_time_constant: MotorLag
    action_latency_steps: Annotated[Whole, Ge(0), Le(20), Unit("control steps")] = static()
    control_rate: Annotated[Whole, Ge(50), Le(1000), Unit("Hz")] = static(default=100)  # of the controller (paper R6)
    sources: dict[str, str] = label(default_factory=dict)

    def __repr__(self) -> str:
        return f"Vehicle({self.name}, {self.mass} kg)"

    @property
    def control_period(self) -> float:
        """The time between two actions in s."""
        return 1 / self.control_rate

    @property
    def hover_square(self) -> Any:
        """g m / 4 kf in rpm^2: the squared rotor speed that hovers where thrust has no linear part (paper R5)."""
        return self.gravity * self.mass / (4 * self.thrust_coefficient)

    @property
    def hover_rotor_speed_rpm(self) -> Any:
        """The rotor speed at which four propellers carry the weight, in rpm."""
        return self.speed_of_square(self.hover_square)

    @property
    def top_rotor_speed_rpm(self) -> Any:
        """The largest rotor speed of the motors in rpm."""
        if self.thrust_to_weight is not None:
            return self.speed_of_square(self.thrust_to_weight * self.hover_square)
        return self.maximum_rotor_speed_rpm

    def square_of_speed(self, speed: Any) -> Any:
        """Thrust over thrust_coefficient in rpm^2 of a rotor speed in rpm; without a linear part the square of it."""
        if self.thrust_linear is None:
            return speed * speed
        return speed * (speed + self.thrust_linear / self.thrust_coefficient)

    def speed_of_square(self, square: Any) -> Any:
        """The rotor speed in rpm of a thrust over thrust_coefficient in rpm^2, 0 or more."""
        if self.thrust_linear is None:
            return square**0.5
        half = self.thrust_linear / self.thrust_coefficient / 2
        return (half * half + square) ** 0.5 - half

    @property
    def full_action_rotor_speed_rpm(self) -> Any:
        """The rotor speed that an action of 1 asks for, in rpm, of a vehicle with plain numbers."""
        if self.action_scale is None:
            return self.top_rotor_speed_rpm
        return min(self.hover_rotor_speed_rpm * (1 + self.action_scale), self.top_rotor_speed_rpm)

    @property
    def full_thrust_to_weight(self) -> float:
        """Largest thrust the actions can ask for, over the weight, of a vehicle with plain numbers."""
        return self.square_of_speed(self.full_action_rotor_speed_rpm) / self.hover_square

    @property
    def lever(self) -> float:
        """Distance of each motor from the x and from the y axis in metres, arm / sqrt(2) (paper R4).

        Raises:
            ValueError: the vehicle gives its rotors' places instead of an arm.
        """
        if self.arm is None:
            raise ValueError("a vehicle with [rotors] has no single lever")
        return self.arm / math.sqrt(2)

    def problem(self) -> str | None:
        """What makes the numbers impossible together, or None."""
        if self.arm is None and self.rotors is None:
            return "arm: missing. Allowed: above 0 m, or a table [rotors] with the place and spin of each rotor."
        if self.arm is not None and self.rotors is not None:
            return 'arm: stands beside [rotors], which say where the rotors are. Give one, and "none" for the other.'
        return (
            self._problem_of_range()
            or self._problem_of_curves()
            or implausible(self)
            or self._problem_of_hover()
            or self._problem_of_inertia()
        )

    def _problem_of_range(self) -> str | None:
        """What is missing of, or stands twice for, the range of the rotors and of the actions."""
        if self.maximum_rotor_speed_rpm is None and self.thrust_to_weight is None:
            return "maximum_rotor_speed_rpm: missing. Allowed: above 0 rpm, or thrust_to_weight in place of it."
        if self.maximum_rotor_speed_rpm is not None and self.thrust_to_weight is not None:
            return (
                "thrust_to_weight: stands beside maximum_rotor_speed_rpm, which says the same. Give one, and "
                '"none" for the other.'
            )
        if self.action_convention == "hover_relative" and self.action_scale is None:
            return (
                "action_scale: missing. Allowed: above 0 to 3; or action_convention = rotor_speed or thrust, which "
                "need none."
            )
        if self.action_convention != "hover_relative" and self.action_scale is not None:
            return (
                f"action_scale: has no meaning with action_convention = {self.action_convention}, whose actions go "
                'from the least to the largest. Leave it out, or give "none".'
            )
        return None

    def _problem_of_curves(self) -> str | None:
        """What makes thrust or torque fall with rotor speed, or negative, within the rotors' range."""
        lowest = self.minimum_rotor_speed_rpm
        for name in ("thrust", "torque"):
            linear = getattr(self, f"{name}_linear")
            zero = 0.0 if linear is None else -linear / getattr(self, f"{name}_coefficient")
            if zero > lowest:
                return (
                    f"{name}_linear: {linear:g} makes the {name} of a rotor negative below {zero:.0f} rpm. Allowed: "
                    f"minimum_rotor_speed_rpm of at least {math.ceil(zero)}, or a linear part of 0 or more."
                )
        return None

    def _problem_of_hover(self) -> str | None:
        """What keeps the rotors from hovering within their range."""
        hover = self.hover_rotor_speed_rpm
        if not self.minimum_rotor_speed_rpm < hover:
            return (
                f"minimum_rotor_speed_rpm: {self.minimum_rotor_speed_rpm:g} is not below the hover speed, {hover:.0f} "
                f"rpm, so that the vehicle cannot sink. Allowed: 0 to {math.floor(hover)}."
            )
        return None

    def _problem_of_inertia(self) -> str | None:
        """What keeps the inertia from being a rigid body's."""
        moments = np.linalg.eigvalsh(inertia_matrix(self))
        shown = list(self.inertia)
        if self.products_of_inertia is None:
            if 2 * moments[2] > moments.sum() * (1 + 1e-9):
                return f"inertia: {shown} is no rigid body's. Allowed: each at most the sum of the other two."
        elif not (moments[0] > 0 and 2 * moments[2] <= moments.sum() * (1 + 1e-9)):
            principal = ", ".join(f"{each:.4g}" for each in moments)
            return (
                f"products_of_inertia: {list(self.products_of_inertia)} with inertia {shown} is no rigid body's: its "
                f"principal moments are {principal}. Allowed: each above 0 and at most the sum of the other two."
            )
        return None


@pytree
class TrueVehicle(Vehicle):
    """A vehicle that differs from the one that its controller was made for.

    An action asks for the rotor speed that it would mean on `nominal`.
    """

    nominal: Vehicle


def inertia_matrix(vehicle: Vehicle) -> np.ndarray:
    """The matrix of inertia [3, 3] about the centre of mass in kg m^2, of a vehicle with plain numbers."""
    matrix = np.diag([float(each) for each in vehicle.inertia])
    for (row, column), product in zip(((0, 1), (0, 2), (1, 2)), vehicle.products_of_inertia or (), strict=False):
        matrix[row, column] = matrix[column, row] = float(product)
    return matrix


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
    if name.endswith((".urdf", ".sdf", ".xml")):
        raise BadInput(
            f"{where}vehicle: {name} is a model of another program. Make a vehicle of it: flytune vehicle {name} --out "
            "mine.toml."
        )
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
