"""A vehicle as far as a file tells it: numbers with their sources, and what is missing with how to measure it."""

import dataclasses
import functools
import math
from typing import Any

import numpy as np
import tomlkit

from flytune.config import document
from flytune.config.fields import annotations, unit_text
from flytune.errors import BadInput
from flytune.physics.plausibility import AIR_DENSITY, Figure, figures
from flytune.physics.vehicle import Vehicle

MARK = "# Written by: flytune vehicle"  # in every file that the command writes, so that it may replace it
TO_MEASURE = {  # what a file may lack, and how a person gets it
    "mass": "weigh the vehicle ready to fly, with its battery",
    "inertia": "about x, y, z; hang the vehicle on two strings of length L with distance d and time one swing T about "
    "the vertical axis: m g d^2 T^2 / (16 pi^2 L); or take it from CAD",
    "rotors": "where the rotors stand from the centre of mass, x forward, y left, and how they spin",
    "rotors.spin": "seen from above, 1 for a propeller that turns clockwise, -1 for the other; one for each place",
    "thrust_coefficient": "thrust of one rotor over its squared speed, on a thrust stand; or hover, and read the rotor "
    "speed from the telemetry: m g / (4 rpm^2)",
    "torque_coefficient": "torque of one rotor over its squared speed, on a thrust stand; or from the maker's data, "
    "torque = mechanical power / (rpm 2 pi / 60)",
    "propeller_radius": "half the diameter of the propeller; 5 inches give 0.0635",
    "maximum_rotor_speed_rpm": "the rotor speed at full throttle, from the telemetry or a thrust stand; or instead "
    "thrust_to_weight: full thrust of all rotors over the weight",
    "motor_rise_time_constant": "log the rotor speed after a step up of the throttle: the time to 63 % of the step",
    "motor_fall_time_constant": "log the rotor speed after a step down of the throttle: the time to 63 % of the step",
    "action_scale": "the square root of thrust to weight, less 1; full action is then full thrust",
    "drag": "fly at a constant speed: m g tan(tilt) / speed, along x, y, z",
    "gravity": "9.81 on Earth",
    "action_latency_steps": "time from a command to the motor's answer, in control steps; 0 where it is below one step",
}
ALONE = {  # fields without which the others can be checked together
    "motor_rise_time_constant", "motor_fall_time_constant", "action_latency_steps", "action_scale", "drag", "gravity",
    "rotors.spin",
}  # fmt: skip
LARGEST_SCALE = 3.0  # that the field accepts
ASSUMED = {  # what no simulator's file holds, and the value it is flown with until it is measured
    "drag": ([0.0, 0.0, 0.0], "assumed: none, as the file gives none"),
    "gravity": (9.81, "assumed: on Earth"),
    "action_latency_steps": (0, "assumed: commands act at once"),
}


@dataclasses.dataclass(frozen=True)
class FoundVehicle:
    """What a file tells of a vehicle."""

    name: str
    table: dict[str, Any]  # the fields of a vehicle, as in its TOML file
    sources: dict[str, str]  # where each number comes from
    notes: tuple[str, ...] = ()  # what the file holds and flytune does not use, and what should be checked
    hints: dict[str, str] = dataclasses.field(default_factory=dict)  # what the file says of a missing number

    @property
    def missing(self) -> dict[str, str]:
        """The fields that flytune needs and the file lacks, each with how to measure it."""
        names = [field.name for field in dataclasses.fields(Vehicle) if _is_required(field)]
        lacking = [name for name in names if name not in self.table]
        if not {"maximum_rotor_speed_rpm", "thrust_to_weight"} & set(self.table):
            lacking.append("maximum_rotor_speed_rpm")
        if (
            self.table.get("action_convention", "hover_relative") == "hover_relative"
            and "action_scale" not in self.table
        ):
            lacking.append("action_scale")
        rotors = self.table.get("rotors")
        if "arm" not in self.table and rotors is None:
            lacking.append("rotors")
        elif rotors is not None and "spin" not in rotors:
            lacking.append("rotors.spin")
        return {name: self.hints.get(name) or TO_MEASURE[name] for name in lacking}

    @property
    def assumed(self) -> dict[str, str]:
        """The fields whose value is assumed, each with how to measure it."""
        return {
            name: TO_MEASURE[name]
            for name in self.table
            if name in ASSUMED and name != "gravity" and self.sources.get(name, "").startswith("assumed")
        }

    @property
    def units(self) -> dict[str, str]:
        """The unit of each number; "1" where it has none."""
        known = annotations(Vehicle)
        return {name: unit_text(known[name]) or "1" for name in self.table if name in known and name != "rotors"}

    @functools.cached_property
    def vehicle(self) -> Vehicle:
        """The vehicle, with usual numbers in the place of those that are missing.

        Raises:
            BadInput: a number out of its range, a frame that cannot be controlled, or figures that are not plausible.
        """
        tables = {"name": self.name, **_filled(self.table)}
        if set(self.missing) <= ALONE:
            return document.read(Vehicle, tables, where=self.name)
        vehicle = document.read(Vehicle, tables, where=self.name, together=False)
        for figure in self._known(vehicle):
            if not figure.plausible:
                raise BadInput(f"{self.name}: {figure.of}: not plausible: {figure.described}. Check the units.")
        return vehicle

    def figures(self) -> list[Figure]:
        """The derived figures that follow from what is there."""
        return self._known(self.vehicle)

    def _known(self, vehicle: Vehicle) -> list[Figure]:
        lacking = {"arm" if name == "rotors" else name for name in self.missing}
        return [figure for figure in figures(vehicle) if not lacking & set(figure.of.split(", "))]


def from_table(table: dict[str, Any]) -> FoundVehicle:
    """A vehicle as its own TOML file tells it."""
    told = {name: value for name, value in table.items() if name not in ("name", "sources")}
    sources = table.get("sources", {})
    return FoundVehicle(str(table.get("name", "custom")), told, sources if isinstance(sources, dict) else {})


def completed(found: FoundVehicle) -> FoundVehicle:
    """What is found, with the numbers that are assumed, and the action scale at which full action is full thrust.

    Raises:
        BadInput: what is found is no vehicle's.
    """
    table, sources = dict(found.table), dict(found.sources)
    for name, (value, source) in ASSUMED.items():
        if name not in table:
            table[name], sources[name] = value, source
    known = dataclasses.replace(found, table=table, sources=sources)
    lacking = set(known.missing)
    speed_known = not {"maximum_rotor_speed_rpm", "mass", "thrust_coefficient"} & lacking
    if "action_scale" in lacking and ("thrust_to_weight" in table or speed_known):
        scale = known.vehicle.top_rotor_speed_rpm / known.vehicle.hover_rotor_speed_rpm - 1
        table["action_scale"] = min(float(f"{scale:.6g}"), LARGEST_SCALE)
        sources["action_scale"] = "full action is full thrust: largest rotor speed over hover speed, less 1"
    return dataclasses.replace(found, table=table, sources=dict(_in_order(sources, table)))


def text(found: FoundVehicle) -> str:
    """The vehicle as a TOML file: each number with its unit and source, and a comment for each that is missing."""
    lines = [f"# {found.name}.", MARK]
    lines += [f"# {line}" for line in remarks(found)]
    known = annotations(Vehicle)
    missing = found.missing
    for name in known:
        unit = unit_text(known[name]) or "1"
        if name in found.table and name != "rotors":
            lines.append(f"{name} = {tomlkit.item(found.table[name]).as_string()} # {unit}")
        elif name in missing and name != "rotors":
            lines.append(f"# {name} =  # {unit}; missing: {missing[name]}")
    lines += _rotor_lines(found.table.get("rotors"), missing)
    lines += [
        "",
        "[sources]",
        *(f"{name} = {tomlkit.item(source).as_string()}" for name, source in _in_order(found.sources, found.table)),
    ]
    return "\n".join(lines) + "\n"


def remarks(found: FoundVehicle) -> list[str]:
    """Figures, notes and what is assumed, in a line each."""
    return [
        *(f"{figure}{'' if figure.oddness == 0 else _unusual(figure)}" for figure in found.figures()),
        *(f"note: {note}" for note in found.notes),
        *(f"assumed: {name} = {found.table[name]}; to measure it: {how}" for name, how in found.assumed.items()),
    ]


def _unusual(figure: Figure) -> str:
    return f" (unusual: most have {figure.usual[0]:g} to {figure.usual[1]:g})"


def _rotor_lines(rotors: dict[str, Any] | None, missing: dict[str, str]) -> list[str]:
    if "rotors" in missing:
        return [
            "",
            f"# missing: {missing['rotors']}",
            "# [rotors]",
            "# place = [[x, y], [x, y], [x, y], [x, y]] # m",
            "# spin = [-1, 1, -1, 1] # 1",
        ]
    if rotors is None:
        return []
    lines = ["", "[rotors]", f"place = {tomlkit.item(rotors['place']).as_string()} # m"]
    if "spin" in rotors:
        return [
            *lines,
            f"spin = {tomlkit.item(rotors['spin']).as_string()} # 1: clockwise from above, -1: the other way",
        ]
    return [*lines, f"# spin = [-1, 1, -1, 1] # missing: {missing['rotors.spin']}"]


def _in_order(sources: dict[str, str], table: dict[str, Any]) -> list[tuple[str, str]]:
    """The sources of the numbers that are there, in the order of the fields."""
    return [(name, sources[name]) for name in annotations(Vehicle) if name in sources and name in table]


def _is_required(field: dataclasses.Field[Any]) -> bool:
    return field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING


def _filled(table: dict[str, Any]) -> dict[str, Any]:
    """The table with usual numbers for what it lacks, so that the others can be checked together."""
    rotors = table.get("rotors")
    places = rotors["place"] if rotors else [[table.get("arm", 0.1), 0.0]]
    arm = max(math.hypot(*place) for place in places) or 0.1
    mass, gravity = table.get("mass", 60 * arm**2), table.get("gravity", 9.81)
    radius = table.get("propeller_radius", 0.6 * arm)
    thrust = table.get("thrust_coefficient", 0.1 * AIR_DENSITY * (2 * radius) ** 4 / 60**2)
    usual = {
        "mass": mass, "inertia": [mass * (0.4 * arm) ** 2] * 3, "gravity": gravity, "propeller_radius": radius,
        "thrust_coefficient": thrust, "torque_coefficient": 0.2 * radius * thrust, "drag": [0.0, 0.0, 0.0],
        "action_scale": 0.4,
        "motor_rise_time_constant": 0.02, "motor_fall_time_constant": 0.02, "action_latency_steps": 0,
    }  # fmt: skip
    if rotors is None and "arm" not in table:
        usual["arm"] = arm
    if not {"maximum_rotor_speed_rpm", "thrust_to_weight"} & set(table):
        usual["thrust_to_weight"] = 2.0
    if table.get("action_convention", "hover_relative") != "hover_relative":
        del usual["action_scale"]
    if rotors is not None and "spin" not in rotors:
        around = np.argsort(np.argsort([math.atan2(y, x) for x, y in places]))  # neighbours turn in opposite ways
        usual["rotors"] = {**rotors, "spin": [1 - 2 * int(place % 2) for place in around]}
        return {**usual, **{name: value for name, value in table.items() if name != "rotors"}}
    return {**usual, **table}
