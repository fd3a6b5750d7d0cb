"""Feasibility of a requirement: lower bounds on the settling time by the user's constraints and by the vehicle."""

import math
from functools import partial

import numpy as np
from jaxtyping import Float

from flytune.errors import BadInput
from flytune.evaluation.flights import Flights
from flytune.evaluation.lower_bounds import settling_time_bound, thrust_bound
from flytune.evaluation.metrics import YAW_BAND, wrap_angle, yaw_angle
from flytune.evaluation.statistics import quantile
from flytune.task.task import Task
from flytune.tuning.requirement import AxisLimits, Requirement
from flytune.tuning.rules import is_fixed


def check_feasible(task: Task, requirement: Requirement, flights: Flights, fixed: tuple[str, ...]) -> None:
    """Nothing, where no lower bound on the settling time contradicts the requirement.

    Args:
        task: the task with the constraints and the vehicle of the user.
        requirement: the requirement.
        flights: any flights from the initial conditions of the training set.
        fixed: the field paths the user has set; bounds among them are constraints, others may be edited.

    Raises:
        BadInput: too many trials cannot settle in time; the message names the lower bound and its cause.
    """
    for limits in (requirement, *requirement.others):
        _check_axis(task, requirement, limits, flights, fixed)


def _check_axis(
    task: Task, requirement: Requirement, limits: AxisLimits, flights: Flights, fixed: tuple[str, ...]
) -> None:
    """The same for one axis that is asked for."""
    axis = limits.axis
    compare = partial(_compare, requirement, limits.percentile)
    if axis == "yaw":
        angle = np.abs(wrap_angle(yaw_angle(flights.attitude[:, 0]) - flights.target_yaw))
        for name, end in task.termination.items():
            if end.quantity == "body_rate" and is_fixed(f"termination.{name}.{end.key}", fixed):
                rate = float(end.limit)
                cause = f"the body rate bound of {math.degrees(float(end.limit)):g} deg/s you have set"
                compare(settling_time_bound(angle, rate, YAW_BAND), cause)
        return
    way = np.asarray(flights.target_position - flights.position[:, 0], dtype=np.float64)
    distance = np.linalg.norm(way, axis=1) if axis == "position" else np.abs(way[:, "xyz".index(axis)])
    for name, end in task.termination.items():
        if end.quantity == "speed" and is_fixed(f"termination.{name}.{end.key}", fixed):
            cause = f"the speed bound of {float(end.limit):g} m/s you have set"
            compare(settling_time_bound(distance, float(end.limit)), cause, distance)
    gravity = float(task.vehicle.gravity)
    thrust = float(task.vehicle.full_thrust_to_weight) * gravity
    if axis == "position":
        climb = way[:, 2] / np.maximum(distance, 1e-9)
    else:
        climb = np.sign(way[:, 2]) if axis == "z" else np.zeros(len(distance))
    bound = thrust_bound(distance, thrust - gravity * climb, thrust + gravity * climb)
    compare(bound, f"a thrust of {thrust / gravity:.3g} times the weight", distance)


def _compare(
    requirement: Requirement,
    percentile: float,
    bound: Float[np.ndarray, "N"],
    cause: str,
    distance: Float[np.ndarray, "N"] | None = None,
) -> None:
    """Nothing, where the lower bounds in s allow the required settling time at its percentile; else BadInput."""
    share, wanted = percentile / 100, requirement.maximum_settling_time()
    least = quantile(bound, share)
    if least is None or least <= wanted:
        return
    way = "" if distance is None else f" over {quantile(distance, share):.2f} m"
    allowed = math.ceil(100 * least / (wanted / requirement.settling_time)) / 100
    raise BadInput(
        f"settling-time: {requirement.settling_time:g} s is not possible: with {cause}, percentile "
        f"{percentile:g} of the trials takes at least {least:.2f} s{way} with any controller. "
        f"Allowed: {allowed:g} s or more, or another bound."
    )
