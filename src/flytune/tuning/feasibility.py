"""What no controller can do: lower bounds on the settling time, by the user's own bounds and by the vehicle. NumPy only."""

import math

import numpy as np
from jaxtyping import Float

from flytune.errors import BadInput
from flytune.evaluation.flights import Flights
from flytune.evaluation.metrics import POSITION_BAND, YAW_BAND
from flytune.evaluation.statistics import quantile
from flytune.task.task import Task
from flytune.task.termination import MaximumBodyRate, MaximumSpeed
from flytune.tuning.requirement import Requirement
from flytune.tuning.rules import is_fixed

Times = Float[np.ndarray, "N"]


def thrust_bound(distance: Times, ahead: Float[np.ndarray, "N"] | float, back: Float[np.ndarray, "N"] | float) -> Times:
    """Least time in s from rest into the band around the target and to stay there, whatever the controller.

    The way to the band, D = distance - 0.02 m, is flown with the greatest acceleration `ahead` (m/s^2) and then
    with the greatest deceleration `back`, down to the speed that can still be lost within the band's width of 0.04 m:

        v = sqrt(2 back 0.04),   vp^2 / (2 ahead) + (vp^2 - v^2) / (2 back) = D,   t = vp / ahead + (vp - v) / back

    Attitude and motors are taken to change at once, so that a true controller always needs longer.
    """
    way = np.maximum(0.0, distance - POSITION_BAND)
    arrival = np.sqrt(2 * np.asarray(back) * 2 * POSITION_BAND)
    peak = np.sqrt((way + arrival**2 / (2 * back)) / (1 / (2 * np.asarray(ahead)) + 1 / (2 * np.asarray(back))))
    brakes = peak > arrival
    return np.where(brakes, peak / ahead + (peak - arrival) / back, np.sqrt(2 * way / ahead))


def check_possible(task: Task, requirement: Requirement, flights: Flights, fixed: tuple[str, ...]) -> None:
    """Nothing, where the requirement does not contradict physics on the starts of these flights.

    Args:
        task: what is flown, with the bounds and the vehicle the user wants.
        requirement: what is wanted.
        flights: any flights from the starts the requirement is judged on.
        fixed: the field paths the user has set; bounds among them are limits, others may be tuned.

    Raises:
        BadInput: too many starts cannot settle in time, with the bound and the numbers behind it.
    """
    axis, share = requirement.axis, requirement.percentile / 100
    wanted = requirement.latest()
    if axis == "yaw":
        angle = _yaw_errors(flights)
        for name, end in task.termination.items():
            if isinstance(end, MaximumBodyRate) and is_fixed(f"termination.{name}.bound_deg_per_s", fixed):
                rate = math.radians(float(end.bound_deg_per_s))
                _refuse(requirement, np.maximum(0.0, angle - YAW_BAND) / rate, share, wanted,
                        f"the body rate bound of {float(end.bound_deg_per_s):g} deg/s you have set")  # fmt: skip
        return
    way = np.asarray(flights.target_position - flights.position[:, 0], dtype=np.float64)
    distance = np.linalg.norm(way, axis=1) if axis == "position" else np.abs(way[:, "xyz".index(axis)])
    for name, end in task.termination.items():
        if isinstance(end, MaximumSpeed) and is_fixed(f"termination.{name}.bound", fixed):
            _refuse(requirement, np.maximum(0.0, distance - POSITION_BAND) / float(end.bound), share, wanted,
                    f"the speed bound of {float(end.bound):g} m/s you have set", distance)  # fmt: skip
    gravity = float(task.vehicle.gravity)
    thrust = float(task.vehicle.thrust_to_weight) * gravity
    if axis == "position":
        climb = way[:, 2] / np.maximum(distance, 1e-9)
    else:
        climb = np.sign(way[:, 2]) if axis == "z" else np.zeros(len(distance))
    bound = thrust_bound(distance, thrust - gravity * climb, thrust + gravity * climb)
    _refuse(requirement, bound, share, wanted, f"a thrust of {thrust / gravity:.3g} times the weight", distance)


def _refuse(
    requirement: Requirement, bound: Times, share: float, wanted: float, cause: str, distance: Times | None = None
) -> None:
    least = quantile(bound, share)
    if least is None or least <= wanted:
        return
    way = "" if distance is None else f" over {quantile(distance, share):.2f} m"
    raise BadInput(
        f"settling-time: {requirement.settling_time:g} s is not possible: with {cause}, percentile "
        f"{requirement.percentile:g} of the starts needs at least {least:.2f} s{way}, whoever flies. "
        f"Allowed: {math.ceil(100 * least / (wanted / requirement.settling_time)) / 100:g} s or more, or another bound."
    )


def _yaw_errors(flights: Flights) -> Times:
    x, y, z, w = np.moveaxis(np.asarray(flights.attitude[:, 0], dtype=np.float64), -1, 0)
    yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    return np.abs((yaw - flights.target_yaw + np.pi) % (2 * np.pi) - np.pi)
