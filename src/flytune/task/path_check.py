"""Whether a path can be flown within the bounds of its task: a path faster than they allow is refused. NumPy only."""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from flytune.task.target import Point, sampled
from flytune.task.termination import Bounded
from flytune.task.waypoints import Waypoints

FINENESS = 0.01  # s between the samples of a path
ROUNDING = 1.001  # by which differences of samples may exceed a bound
WORDS = {  # quantity -> what a path asks for, factor from SI units to the unit of the bound, unit
    "speed": ("a speed", 1.0, "m/s"),
    "tilt": ("a tilt", 180 / math.pi, "deg"),
    "body_rate": ("a body rate", 180 / math.pi, "deg/s"),
}


def problem_of_path(
    target: Any, termination: Mapping[str, Bounded], gravity: float, thrust_to_weight: float, duration: float
) -> str | None:
    """What of a path no controller can fly within the bounds, or None; its attitude is that of `Path.reference`.

    Args:
        target: the target of a task.
        termination: its terminations.
        gravity: m/s^2.
        thrust_to_weight: of its vehicle.
        duration: s, over which the path is flown.
    """
    if isinstance(target, Point) or (isinstance(target, Waypoints) and target.table is None):
        return None  # waypoints without a table have a problem of their own
    end = min(duration, float(target.times[-1])) if isinstance(target, Waypoints) else duration
    time = np.arange(0.0, max(end, 4 * FINENESS) + FINENESS / 2, FINENESS)
    place, yaw = sampled(target, time)
    for name, bound in termination.items():
        lowest = int(place[:, 2].argmin())
        if bound.quantity == "altitude" and place[lowest, 2] <= float(bound.limit):
            return (
                f"target: the path is {place[lowest, 2]:.3g} m high at {time[lowest]:.3g} s, and "
                f"termination.{name}.{bound.key} is {float(bound.limit):g} m. Give a higher path, or a lower bound."
            )
    if isinstance(target, Waypoints) and target.interpolation == "steps":
        return None
    velocity = _rate(place)
    thrust = _rate(velocity) + np.array([0.0, 0.0, gravity])
    size = np.linalg.norm(thrust, axis=-1, keepdims=True)
    upwards = thrust / size
    asked = {
        "speed": np.linalg.norm(velocity, axis=-1),
        "tilt": np.arccos(np.clip(upwards[:, 2], -1, 1)),
        "body_rate": np.hypot(np.linalg.norm(_rate(upwards), axis=-1), _rate(np.unwrap(yaw))),
    }
    for name, bound in termination.items():
        if bound.quantity not in asked:
            continue
        worst = _first_worst(asked[bound.quantity])
        value, limit = float(asked[bound.quantity][worst]), float(bound.limit)
        if value > limit * ROUNDING:
            words, factor, unit = WORDS[bound.quantity]
            return (
                f"target: a path faster than the bounds allow: at {time[worst]:.3g} s it asks for {words} of "
                f"{value * factor:.3g} {unit}, and termination.{name}.{bound.key} is {limit * factor:g} {unit}. Give "
                f"{_slower(target, bound, value)}, or a bound of at least {value * factor * ROUNDING:.3g} {unit}."
            )
    worst = _first_worst(size[:, 0])
    if (needed := float(size[worst, 0]) / gravity) > thrust_to_weight:
        return (
            f"target: a path faster than the vehicle can fly: at {time[worst]:.3g} s it asks for a thrust of "
            f"{needed:.3g} times the weight. Allowed: up to {thrust_to_weight:.3g}. Give a slower path."
        )
    return None


def _first_worst(values: np.ndarray) -> int:
    """Where the largest value comes first, up to rounding."""
    return int(np.argmax(values >= values.max() / ROUNDING))


def _slower(target: Any, bound: Bounded, value: float) -> str:
    speed = getattr(target, "speed", None)
    if speed is None or bound.quantity != "speed":
        return "a slower path"
    return f"target.speed={float(speed) * float(bound.limit) / value:.4g}"


def _rate(values: np.ndarray) -> np.ndarray:
    return np.gradient(values, FINENESS, axis=0, edge_order=2)
