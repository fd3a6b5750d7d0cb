"""Vehicles and tasks at the corners of what is allowed, for the tests of every room."""

import math
from collections.abc import Iterator
from typing import Any

import annotated_types
import numpy as np

from flytune.config import document
from flytune.config.fields import step_into, unwrap
from flytune.physics.plausibility import AIR_DENSITY, RAD_PER_S
from flytune.physics.vehicle import Vehicle
from flytune.task.files import load_task
from flytune.task.task import Task

INSIDE = 1.001  # a corner lies this factor inside of the limits, so that rounding does not decide
FIGURES = {  # of a vehicle: the limits of physics/plausibility.py and of the fields
    "mass": (0.003, 100),
    "arm": (0.008, 3),
    "gyration": (0.071, 2.17),  # about x and y, so that it lies in 0.05 to 3 about z as well
    "flatness": (0.5, 1.9),  # inertia about z over that about x and y; a rigid body has at most 2
    "coefficient": (0.001, 0.5),
    "tip_speed": (5, 340),
    "torque": (0.0125, 1.6),
    "lift": (1.02, 25),
    "action_scale": (0.01, 3),
    "gravity": (1, 30),
    "lag": (1e-29, 1),
    "slowing": (1e-20, 20),
}


def vehicle_with(share: dict[str, float], latency: int) -> dict[str, Any]:
    """The table of a vehicle whose figures lie at shares of their ranges, 0 to 1 on a logarithmic scale."""
    at = {}
    for name, (low, high) in FIGURES.items():
        bottom, top = math.log(low * INSIDE), math.log(high / INSIDE)
        at[name] = math.exp(bottom + (top - bottom) * share[name])
    mass, gravity, arm = at["mass"], at["gravity"], at["arm"]
    # C_T = kf 4 pi^2 / (rho (2 r)^4) with kf in N/(rad/s)^2, and tip speed = r sqrt(m g / 4 kf)
    radius = math.pi * math.sqrt(mass * gravity / (16 * at["coefficient"] * AIR_DENSITY)) / at["tip_speed"]
    hover = at["tip_speed"] / radius / RAD_PER_S
    thrust = mass * gravity / (4 * hover**2)
    flat = mass * (at["gyration"] * arm) ** 2
    return {
        "name": "corner", "mass": mass, "inertia": [flat, flat, flat * at["flatness"]], "arm": arm,
        "thrust_coefficient": thrust, "torque_coefficient": at["torque"] * radius * thrust, "propeller_radius": radius,
        "drag": [at["slowing"] * mass] * 3, "gravity": gravity, "action_scale": at["action_scale"],
        "maximum_rotor_speed_rpm": hover * math.sqrt(at["lift"]), "motor_rise_time_constant": at["lag"],
        "motor_fall_time_constant": at["lag"] / 2, "action_latency_steps": latency,
    }  # fmt: skip


def vehicles(number: int, latency: int = 0, seed: int = 0) -> list[Vehicle]:
    """Vehicles at corners of the box of all figures, and as many inside of it."""
    random = np.random.default_rng(seed)
    shares = [random.integers(0, 2, len(FIGURES)) for _ in range(number)] + list(random.random((number, len(FIGURES))))
    tables = (vehicle_with(dict(zip(FIGURES, map(float, share), strict=True)), latency) for share in shares)
    return [document.read(Vehicle, table) for table in tables]


def numbers_of(kind: Any, data: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    """The path and the annotation of each real number of a dataclass's tables."""

    for key, value in data.items():
        inner = step_into(kind, key, data)
        here = f"{path}.{key}" if path else key
        if isinstance(value, dict):
            yield from numbers_of(inner, value, here)
        elif isinstance(value, float) or (isinstance(value, list) and value and isinstance(value[0], float)):
            yield here, inner


def ends_of(annotation: Any) -> tuple[float, float]:
    """The least and the largest number that a field accepts."""
    base, details = unwrap(annotation)
    if base is not float and getattr(base, "__args__", None):
        members = [each for each in base.__args__ if each is not type(None)]
        inner, more = unwrap(members[0])
        details = [*details, *more] if inner is float else [*details, *unwrap(members[0])[1]]
    low, high = -1e30, 1e30
    for detail in details:
        match detail:
            case annotated_types.Gt(gt=bound):
                low = max(float(bound) * (1 + 1e-6), 1e-30)
            case annotated_types.Ge(ge=bound):
                low = float(bound)
            case annotated_types.Lt(lt=bound):
                high = float(bound) * (1 - 1e-6)
            case annotated_types.Le(le=bound):
                high = float(bound)
    return low, high


def edits_at_the_ends(preset: str, parts: tuple[str, ...]) -> list[dict[str, Any]]:
    """Edits of a preset, each of one number to an end of its range."""
    data = document.plain(load_task(preset))
    found = []
    for path, annotation in numbers_of(Task, data):
        if path.split(".")[0] in parts:
            size = len(value) if isinstance(value := _at(data, path), list) else 0
            found += [{path: [end] * size if size else end} for end in ends_of(annotation)]
    return found


def _at(data: Any, path: str) -> Any:
    for key in path.split("."):
        data = data[key]
    return data
