"""Plausibility of a vehicle: figures that follow from its numbers, the absurd among them, and the likely slip of unit.

A number in another unit (mm for m, rpm for rad/s) is a number like any other. It shows where several numbers meet: an
arm in mm puts all mass a thousand times nearer to the centre than the motors.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from flytune.physics.vehicle import Vehicle

RAD_PER_S = 2 * math.pi / 60  # of one rpm
LIFT, LEAST_LIFT = "thrust to weight", 1.02
AIR_DENSITY = 1.225  # kg/m^3; ISO 2533, at sea level


@dataclasses.dataclass(frozen=True, kw_only=True)
class Figure:
    """A figure of a vehicle, with limits that no real quadrotor passes and the range in which most lie."""

    name: str
    value: float
    lowest: float
    highest: float
    usual: tuple[float, float]
    of: str  # the fields it follows from
    unit: str = ""

    @property
    def plausible(self) -> bool:
        """Whether a real vehicle may have it."""
        return self.lowest <= self.value <= self.highest

    @property
    def oddness(self) -> float:
        """How far it lies outside of the usual range, as a factor's logarithm."""
        low, high = (max(each, 1e-12) for each in self.usual)
        return max(0.0, math.log(low / max(self.value, 1e-12)), math.log(max(self.value, 1e-12) / high))

    @property
    def described(self) -> str:
        """Its value with what is allowed and what is usual, in words."""
        return (
            f"{self.name} is {_number(self.value)}{self.unit}. Allowed: {_number(self.lowest)} to "
            f"{_number(self.highest)}{self.unit} (usual: {self.usual[0]:g} to {self.usual[1]:g})"
        )

    def __str__(self) -> str:
        return f"{self.name} {_number(self.value)}{self.unit}"


def figures(vehicle: Vehicle) -> list[Figure]:
    """The figures of a vehicle with plain numbers.

    C_T = kf n^2 / (rho n^2 (2 r)^4) is the thrust coefficient of propeller theory, with n the rotor speed per second.
    It compares the thrust coefficient with the size of the propeller, whatever the mass.
    """
    arm = reach_of(vehicle)
    mass, radius = vehicle.mass, vehicle.propeller_radius
    gyration = [math.sqrt(moment / mass) / arm for moment in vehicle.inertia]
    hover = vehicle.hover_rotor_speed_rpm
    tip = hover * RAD_PER_S * radius
    ratio = torque_over_thrust(vehicle)
    # of the quadratic curve through the thrust at hover
    coefficient = mass * vehicle.gravity / 4 / hover**2 * 60**2 / (AIR_DENSITY * (2 * radius) ** 4)
    found = [
        Figure(name="mass", value=mass, lowest=0.003, highest=100, usual=(0.02, 25), of="mass", unit=" kg"),
        Figure(name="arm", value=arm, lowest=0.008, highest=3, usual=(0.02, 0.6), of="arm", unit=" m"),
        Figure(
            name="largest radius of gyration over arm", value=max(gyration), lowest=0.05, highest=3,
            usual=(0.4, 0.8), of="inertia, mass, arm",
        ),
        Figure(
            name="smallest radius of gyration over arm", value=min(gyration), lowest=0.05, highest=3,
            usual=(0.2, 0.6), of="inertia, mass, arm",
        ),
        Figure(
            name="thrust coefficient C_T", value=coefficient, lowest=0.001, highest=0.5,
            usual=(0.03, 0.2), of="thrust_coefficient, propeller_radius",
        ),
        Figure(
            name="propeller tip speed at hover", value=tip, lowest=5, highest=340,
            usual=(30, 150), of="mass, thrust_coefficient, propeller_radius", unit=" m/s",
        ),
        Figure(
            name="torque over thrust", value=ratio / radius, lowest=0.0125, highest=1.6,
            usual=(0.1, 0.35), of="torque_coefficient, thrust_coefficient, propeller_radius", unit=" propeller radii",
        ),
        Figure(
            name=f"{LIFT} of the motors",
            value=vehicle.square_of_speed(vehicle.top_rotor_speed_rpm) / vehicle.hover_square, lowest=LEAST_LIFT,
            highest=25, usual=(1.3, 12), of="maximum_rotor_speed_rpm, mass, thrust_coefficient",
        ),
        Figure(
            name=f"{LIFT} at full action", value=vehicle.full_thrust_to_weight, lowest=LEAST_LIFT, highest=25,
            usual=(1.3, 12), of="action_scale, maximum_rotor_speed_rpm, mass, thrust_coefficient",
        ),
        Figure(
            name="drag over mass", value=max(vehicle.drag) / mass, lowest=0, highest=20, usual=(0.0, 1.0),
            of="drag, mass", unit=" 1/s",
        ),
    ]  # fmt: skip
    slowing = {  # the rate in 1/s at which each kind of drag slows the vehicle; the quadratic one at 10 m/s
        "rotor_drag": ("rotor drag at hover over mass", 4 * hover * RAD_PER_S),
        "optional_rotor_drag": ("optional rotor drag at hover over mass", 4 * hover * RAD_PER_S),
        "body_drag": ("body drag over mass", 1.0),
        "quadratic_drag": ("quadratic drag at 10 m/s over mass", 10.0),
    }
    for field, (name, factor) in slowing.items():
        if (values := getattr(vehicle, field)) is not None:
            found.append(
                Figure(
                    name=name, value=max(values) * factor / mass, lowest=0, highest=20, usual=(0.05, 1),
                    of=f"{field}, mass", unit=" 1/s",
                )
            )  # fmt: skip
    return found


def torque_over_thrust(vehicle: Vehicle) -> float:
    """The drag torque of a rotor over its thrust at hover, in m, of a vehicle with plain numbers."""
    hover = vehicle.hover_rotor_speed_rpm
    torque = vehicle.torque_coefficient * hover**2 + (vehicle.torque_linear or 0.0) * hover
    return torque / (vehicle.mass * vehicle.gravity / 4)


def summary(vehicle: Vehicle) -> str:
    """The figures that a person checks first, in one line."""
    gyration = ", ".join(_number(math.sqrt(each / vehicle.mass) / reach_of(vehicle)) for each in vehicle.inertia)
    ratio = 1000 * torque_over_thrust(vehicle)
    hover = vehicle.hover_rotor_speed_rpm
    coefficient = next(each for each in figures(vehicle) if each.name.startswith("thrust coefficient"))
    return (
        f"hovers at {hover:.0f} rpm (propeller tips at {hover * RAD_PER_S * vehicle.propeller_radius:.0f} m/s); "
        f"thrust to weight {vehicle.full_thrust_to_weight:.3g}; torque over thrust {ratio:.3g} mm; "
        f"radius of gyration over arm {gyration} (x, y, z); {coefficient}"
    )


def implausible(vehicle: Vehicle) -> str | None:
    """What no real quadrotor has, with the slip of unit that would explain it; None where all is plausible."""
    wrong = _wrong(vehicle)
    if not wrong:
        return None
    # the slip that explains most, and then leaves the most usual vehicle
    slip, changed = min(_repaired(vehicle), key=lambda each: (len(_wrong(each[1])), _oddness(each[1])))
    left = {figure.name for figure in _wrong(changed)}
    weak = all(figure.name.startswith(LIFT) for figure in wrong)  # which may simply be true of it
    if len(left) >= (1 if weak else len(wrong)):
        first = wrong[0]
        if first.name.startswith(LIFT):
            return (
                _too_weak(vehicle) if first.value < first.lowest else f"{first.of}: {first.described}. Check the units."
            )
        return f"{first.of}: not plausible: {first.described}. Check the units."
    first = next(each for each in wrong if each.name not in left)
    names = ", ".join(_field(vehicle, name) for name in slip.fields)
    values = ", ".join(_value(vehicle, name) for name in slip.fields)
    write = ", ".join(f"{_field(vehicle, name)} = {_value(changed, name)}" for name in slip.fields)
    are, they = ("is", "Is it") if len(slip.fields) == 1 else ("are", "Are they")
    # a propeller of 10 inches has a radius of 12.7 cm: a number of 10 may mean this, or a radius of 10 cm
    near = (
        f", or {_value(other, each.fields[0])} if it is {each.words}"
        for each, other in _repaired(vehicle)
        if each is not slip and each.fields == slip.fields == ("propeller_radius",) and not _wrong(other)
        and abs(math.log(each.factors[0] / slip.factors[0])) < math.log(1.5)
    )  # fmt: skip
    write += "".join(near)
    return f"{names}: {values} {are} not plausible: {first.described}. {they} {slip.words}? Then write {write}."


def _too_weak(vehicle: Vehicle) -> str:
    """The line for a vehicle that cannot lift itself."""
    hover = vehicle.hover_rotor_speed_rpm
    least = math.sqrt(LEAST_LIFT)
    if vehicle.maximum_rotor_speed_rpm is not None and vehicle.maximum_rotor_speed_rpm < least * hover:
        return (
            f"maximum_rotor_speed_rpm: {_rounded(vehicle.maximum_rotor_speed_rpm)} cannot lift the vehicle. "
            f"Allowed: above the hover speed, {hover:.0f} rpm, by 1 % or more."
        )
    return (
        f"action_scale: {_rounded(vehicle.action_scale or 0.0)} cannot lift the vehicle: full action gives "
        f"{vehicle.full_thrust_to_weight:.3g} times its weight. Allowed: {least - 1:.2g} or more."
    )


@dataclasses.dataclass(frozen=True)
class _Slip:
    """Fields that may be given in another unit, and what each then has to be multiplied with."""

    fields: tuple[str, ...]
    unit: str
    factors: tuple[float, ...]
    diameter: bool = False  # given in place of a radius

    @property
    def words(self) -> str:
        """What the number is then, for a question."""
        return f"the diameter in {self.unit}" if self.diameter else f"in {self.unit}"


_RPM = 1 / RAD_PER_S  # in one rad/s
_SLIPS = (
    *(_Slip((name,), unit, (factor,)) for name in ("arm", "propeller_radius")
      for unit, factor in (("mm", 1e-3), ("cm", 1e-2), ("inches", 0.0254))),
    *(_Slip(("propeller_radius",), unit, (factor / 2,), diameter=True)
      for unit, factor in (("mm", 1e-3), ("cm", 1e-2), ("inches", 0.0254), ("m", 1.0))),
    *(_Slip(("arm", "propeller_radius"), unit, (factor, factor))
      for unit, factor in (("mm", 1e-3), ("cm", 1e-2), ("inches", 0.0254))),
    _Slip(("mass",), "g", (1e-3,)),
    *(_Slip(("inertia",), unit, (factor,)) for unit, factor in
      (("g cm^2", 1e-7), ("g m^2", 1e-3), ("kg cm^2", 1e-4), ("kg mm^2", 1e-6), ("g mm^2", 1e-9))),
    _Slip(("maximum_rotor_speed_rpm",), "rad/s", (_RPM,)),
    _Slip(("maximum_rotor_speed_rpm",), "revolutions per second", (60,)),
    _Slip(("thrust_coefficient",), "N/(rad/s)^2", (RAD_PER_S**2,)),
    _Slip(("torque_coefficient",), "N m/(rad/s)^2", (RAD_PER_S**2,)),
    _Slip(("thrust_coefficient", "torque_coefficient"), "N/(rad/s)^2 and N m/(rad/s)^2", (RAD_PER_S**2,) * 2),
    _Slip(("thrust_coefficient", "torque_coefficient", "maximum_rotor_speed_rpm"), "rad/s instead of rpm",
          (RAD_PER_S**2, RAD_PER_S**2, _RPM)),
    _Slip(("thrust_coefficient",), "N/(revolutions per second)^2", (1 / 3600,)),
    _Slip(("thrust_coefficient", "torque_coefficient"), "N and N m/(revolutions per second)^2", (1 / 3600,) * 2),
    _Slip(("mass", "inertia"), "g and g cm^2", (1e-3, 1e-7)),
    _Slip(("mass", "inertia"), "g and g m^2", (1e-3, 1e-3)),
    _Slip(("drag",), "g/s", (1e-3,)),
    # the opposite: converted twice, or the wrong way
    _Slip(("maximum_rotor_speed_rpm",), "rpm, and was converted to it once too often", (RAD_PER_S,)),
    _Slip(("thrust_coefficient",), "N/rpm^2, and was converted to it once too often", (_RPM**2,)),
    _Slip(("torque_coefficient",), "N m/rpm^2, and was converted to it once too often", (_RPM**2,)),
    _Slip(("thrust_coefficient", "torque_coefficient"), "units of rpm, and were converted to it once too often",
          (_RPM**2, _RPM**2)),
    _Slip(("arm",), "m, and was divided by 1000 once too often", (1e3,)),
    _Slip(("propeller_radius",), "m, and was divided by 1000 once too often", (1e3,)),
    _Slip(("mass",), "kg, and was divided by 1000 once too often", (1e3,)),
)  # fmt: skip


def _repaired(vehicle: Vehicle) -> Iterator[tuple[_Slip, Any]]:
    """The vehicle as it is meant, for each slip."""
    for slip in _SLIPS:
        if any(getattr(vehicle, name) is None for name in slip.fields if name != "arm"):
            continue
        changes: dict[str, Any] = {}
        for name, factor in zip(slip.fields, slip.factors, strict=True):
            if name == "arm" and vehicle.rotors is not None:
                place = tuple(tuple(factor * part for part in each) for each in vehicle.rotors.place)
                changes["rotors"] = dataclasses.replace(vehicle.rotors, place=place)
                continue
            value = getattr(vehicle, name)
            changes[name] = tuple(factor * part for part in value) if isinstance(value, tuple) else factor * value
        yield slip, dataclasses.replace(vehicle, **changes)


def _wrong(vehicle: Vehicle) -> list[Figure]:
    return [figure for figure in figures(vehicle) if not figure.plausible]


def _oddness(vehicle: Vehicle) -> float:
    return sum(figure.oddness for figure in figures(vehicle))


def reach_of(vehicle: Vehicle) -> float:
    """Distance of the farthest rotor from the centre in m, of a vehicle with plain numbers."""
    if vehicle.rotors is not None:
        return max(math.hypot(*map(float, each)) for each in vehicle.rotors.place)
    return float(vehicle.arm or math.nan)


def _field(vehicle: Vehicle, name: str) -> str:
    return "rotors.place" if name == "arm" and vehicle.rotors is not None else name


def _value(vehicle: Vehicle, name: str) -> str:
    if name == "arm" and vehicle.rotors is not None:
        return str([[_rounded(part) for part in each] for each in vehicle.rotors.place])
    value = getattr(vehicle, name)
    return str([_rounded(part) for part in value]) if isinstance(value, tuple) else str(_rounded(value))


def _rounded(value: float) -> float:
    return float(f"{value:.6g}")


def _number(value: float) -> str:
    return f"{value:.3g}" if 1e-3 <= abs(value) < 1e4 or value == 0 else f"{value:.1e}"
