"""Sensitivities: the measured effect of each parameter of a task on the response, all others as in baseline-refined."""

import dataclasses
import itertools
import json
import math
import statistics
from collections.abc import Mapping, Sequence
from importlib import resources
from typing import Any, Literal

import numpy as np

FLOOR = {"settling_time": 1e-6, "overshoot": 0.002, "error": 1e-6}  # smaller values of a measure count as this one
NO_EFFECT = {"settling_time": 0.1, "overshoot": 0.005, "error": 0.1}  # smaller changes over a whole curve are none
THRESHOLD = 0.8  # an effect has a threshold where one interval has this share of the whole change


@dataclasses.dataclass(frozen=True, kw_only=True)
class SeedResult:
    """The response after one training at one value of a parameter; None where too few trials have the measure."""

    seed: int
    settled: int  # number of trials whose position settled
    settling_time: float | None  # s, median of the position
    overshoot: float | None  # fraction of the step, median of the position
    error: float | None  # m, median of the position
    settling_time_axes: Mapping[str, float | None]  # the same for x, y, z and yaw
    overshoot_axes: Mapping[str, float | None]
    yaw_error: float | None  # rad, median
    violations: Mapping[str, int]  # termination -> trials that violate it
    crashed: int  # number of trials

    def number(self, measure: str, axis: str = "position") -> float:
        """A measure of an axis, +inf where too few trials have it; the error of x, y and z is that of the position."""
        if measure == "error":
            value = self.yaw_error if axis == "yaw" else self.error
        else:
            value = getattr(self, measure) if axis == "position" else getattr(self, f"{measure}_axes").get(axis)
        return math.inf if value is None else float(value)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Point:
    """All trainings at one value of a parameter, one per seed."""

    value: float
    seeds: Sequence[SeedResult]

    def numbers(self, measure: str, axis: str = "position") -> list[float]:
        """The measure of each seed, +inf where too few trials have it."""
        return [result.number(measure, axis) for result in self.seeds]

    def median(self, measure: str, axis: str = "position") -> float:
        """The median over the seeds."""
        return statistics.median_low(self.numbers(measure, axis))

    def differs_from(self, other: "Point", measure: str, axis: str = "position") -> bool:
        """Whether the measure of every seed here is above, or below, that of every seed at the other value."""
        mine, others = self.numbers(measure, axis), other.numbers(measure, axis)
        return max(mine) < min(others) or max(others) < min(mine)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Curve:
    """The effect of one parameter: its points in the order of their values."""

    baseline: float
    points: Sequence[Point]

    def interval(self, value: float, up: bool = True) -> tuple[Point, Point]:
        """The two neighbouring points between which the parameter moves if it is raised, or lowered, from `value`.

        Beyond the ends these are the outermost two points. A value of 0 is left out.
        """
        pairs = list(itertools.pairwise(point for point in self.points if point.value > 0))
        around = (pair for pair in pairs if (pair[1].value > value if up else pair[1].value >= value))
        return next(around, pairs[-1])


@dataclasses.dataclass(frozen=True, kw_only=True)
class Sensitivities:
    """The curves of all parameters."""

    facts: Mapping[str, Any]  # command, base task, updates, trials, duration, seeds, versions
    parameters: Mapping[str, Curve]  # field path -> curve

    def slope(self, path: str, measure: str, value: float, axis: str = "position", up: bool = True) -> float | None:
        """d log(measure) / d log(parameter) in the interval at `value`, from the medians over the seeds.

        None where the parameter was not measured, or where a median is infinite.

        Args:
            path: field path of the parameter.
            measure: settling_time, overshoot or error.
            value: value of the parameter, in its own unit.
            axis: position, x, y, z or yaw.
            up: whether the parameter is to be raised.
        """
        if path not in self.parameters:
            return None
        low, high = self.parameters[path].interval(value, up)
        first, second = (max(point.median(measure, axis), FLOOR[measure]) for point in (low, high))
        if not (math.isfinite(first) and math.isfinite(second)):
            return None
        return math.log(second / first) / math.log(high.value / low.value)

    def is_significant(self, path: str, measure: str, value: float, axis: str = "position", up: bool = True) -> bool:
        """Whether the seeds differ between the ends of the interval at `value`; True where it was not measured.

        Args: those of `slope`.
        """
        if path not in self.parameters:
            return True
        low, high = self.parameters[path].interval(value, up)
        return low.differs_from(high, measure, axis)

    def has_effect(self, path: str, axis: str = "position") -> bool:
        """Whether the parameter changes any measure over its whole range; True where it was not measured."""
        if path not in self.parameters:
            return True
        first, *others = self.parameters[path].points
        return any(first.differs_from(other, measure, axis) for other in others for measure in FLOOR)

    def same_interval(self, path: str, value: float, up: bool, other: float) -> bool:
        """Whether `value` and `other` lie in the same interval of the parameter; True where it was not measured."""
        if path not in self.parameters:
            return True
        curve = self.parameters[path]
        return curve.interval(value, up) == curve.interval(other, up)

    def check_claim(
        self, path: str, measure: str, direction: Literal["up", "down"], axis: str = "position"
    ) -> Literal["confirmed", "wrong sign", "no effect", "only beyond a threshold"]:
        """The outcome of the claim that raising the parameter moves the measure in `direction`, from the whole curve.

        No effect: from the first to the last value the measure changes by less than 10 % (0.005 for the overshoot), or
        the seeds at the two values do not differ. Only beyond a threshold: one interval between neighbouring values has
        at least 80 % of the change. Values with an infinite median are left out.

        Args:
            path: field path of the parameter.
            measure: settling_time, overshoot or error.
            direction: the claimed one, up or down.
            axis: position, x, y, z or yaw.
        """
        points = [point for point in self.parameters[path].points if math.isfinite(point.median(measure, axis))]
        if len(points) < 2:
            return "no effect"
        medians = [point.median(measure, axis) for point in points]
        change = medians[-1] - medians[0]
        least = NO_EFFECT[measure] * (1.0 if measure == "overshoot" else min(medians))
        if abs(change) < least or not points[0].differs_from(points[-1], measure, axis):
            return "no effect"
        if (change > 0) != (direction == "up"):
            return "wrong sign"
        shares = np.diff(medians) / change
        return "only beyond a threshold" if len(shares) > 1 and shares.max() >= THRESHOLD else "confirmed"


def load_sensitivities() -> Sensitivities:
    """The sensitivities that ship with flytune, measured by `python benchmarks/sensitivity.py`."""
    facts = json.loads((resources.files("flytune.tuning") / "sensitivity.json").read_text(encoding="utf-8"))
    parameters = {
        path: Curve(
            baseline=curve["baseline"],
            points=[
                Point(value=point["value"], seeds=[SeedResult(**seed) for seed in point["seeds"]])
                for point in curve["points"]
            ],
        )
        for path, curve in facts.pop("parameters").items()
    }
    return Sensitivities(facts=facts, parameters=parameters)
