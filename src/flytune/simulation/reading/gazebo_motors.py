"""Motor models of Gazebo, as PX4 and RotorS use them: `gz-sim-multicopter-motor-model` and `gazebo_motor_model`.

    thrust = motorConstant w^2,   torque = momentConstant thrust,   drag force = -rotorDragCoefficient w v_perpendicular

with the rotor speed w in rad/s, and a first-order lag, `timeConstantUp` and `timeConstantDown`.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any

from flytune.errors import BadInput
from flytune.physics.plausibility import RAD_PER_S
from flytune.simulation.reading.markup import Element, number

SPINS = {"cw": 1, "ccw": -1}  # turningDirection, as seen from above
FIELDS = {  # element of the plugin -> field of a vehicle, and the factor from rad/s to rpm
    "motorConstant": ("thrust_coefficient", RAD_PER_S**2),
    "timeConstantUp": ("motor_rise_time_constant", 1.0),
    "timeConstantDown": ("motor_fall_time_constant", 1.0),
    "maxRotVelocity": ("maximum_rotor_speed_rpm", 1 / RAD_PER_S),
    "minRotVelocity": ("minimum_rotor_speed_rpm", 1 / RAD_PER_S),
}
UNUSED = ("rollingMomentCoefficient",)


@dataclasses.dataclass(frozen=True)
class Motor:
    """A motor model: its number, the link that it turns, its spin, and its numbers as the file has them."""

    number: int
    link: str
    spin: int
    values: dict[str, float]
    plugin: Element


def is_motor(plugin: Element) -> bool:
    """Whether a plugin is a motor model."""
    kind = f"{plugin.get('filename', '')} {plugin.get('name', '')}".lower()
    return "multicopter-motor-model" in kind or "multicoptermotormodel" in kind or "gazebo_motor_model" in kind


def motors(plugins: Sequence[Element], file: str) -> list[Motor]:
    """The motors in the order of their numbers.

    Raises:
        BadInput: a motor without number, link or direction, two with one number, or another type than velocity.
    """
    read = sorted((_motor(plugin, file) for plugin in plugins), key=lambda motor: motor.number)
    taken = [motor.number for motor in read]
    if len(set(taken)) != len(taken):
        raise BadInput(f"{file}: motorNumber: {taken} names a motor twice. Allowed: another number for each motor.")
    return read


def motor_tables(read: Sequence[Motor], file: str) -> tuple[dict[str, Any], dict[str, str], list[str]]:
    """Fields of a vehicle, their sources and notes, from motors that are alike.

    Raises:
        BadInput: the motors differ, or a number is out of any sense.
    """
    table: dict[str, Any] = {}
    sources: dict[str, str] = {}
    values = {name: _shared(name, read, file) for name in read[0].values}
    for name, (field, factor) in FIELDS.items():
        if name in values:
            table[field] = values[name] * factor
            unit = "" if factor == 1 else f" {values[name]:g} in rad/s"
            sources[field] = f"{file}, {name}{unit}"
    if "momentConstant" in values and "motorConstant" in values:
        table["torque_coefficient"] = values["momentConstant"] * table["thrust_coefficient"]
        sources["torque_coefficient"] = f"{file}, momentConstant {values['momentConstant']:g} m times motorConstant"
    if "rotorDragCoefficient" in values:
        across = values["rotorDragCoefficient"]
        table["rotor_drag"] = [across, across, 0.0]
        sources["rotor_drag"] = f"{file}, rotorDragCoefficient; it acts across the rotor's axis"
    notes = [f"{name} is not used" for name in UNUSED if values.get(name)]
    return table, sources, notes


def _motor(plugin: Element, file: str) -> Motor:
    def text(name: str) -> str:
        return (plugin.findtext(name) or "").strip()

    index = text("motorNumber") or text("actuator_number")
    if not index.isdecimal():
        raise BadInput(f"{file}: motorNumber: {index!r} is not allowed. Allowed: 0, 1, 2, 3.")
    where = f"{file}: motor {index}"
    link, direction, kind = text("linkName"), text("turningDirection"), text("motorType") or "velocity"
    if not link:
        raise BadInput(f"{where}: linkName: missing. Allowed: the link of its rotor.")
    if direction not in SPINS:
        raise BadInput(f"{where}: turningDirection: {direction!r} is not allowed. Allowed: cw, ccw.")
    if kind != "velocity":
        raise BadInput(f"{where}: motorType: {kind!r} is not allowed. Allowed: velocity.")
    names = (*FIELDS, "momentConstant", "rotorDragCoefficient", *UNUSED)
    values = {name: number(text(name), f"{where}: {name}") for name in names if plugin.find(name) is not None}
    return Motor(int(index), link, SPINS[direction], values, plugin)


def _shared(name: str, read: Sequence[Motor], file: str) -> float:
    values = [motor.values.get(name) for motor in read]
    if any(value != values[0] for value in values):
        raise BadInput(f"{file}: {name}: the motors differ: {values}. Allowed: the same value for all motors.")
    assert values[0] is not None
    return values[0]
