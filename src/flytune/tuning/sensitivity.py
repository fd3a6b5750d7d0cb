"""The effect map: what each parameter of a task was measured to do to the response, other parameters as in baseline-refined."""

import dataclasses
import json
import math
from collections.abc import Mapping, Sequence
from importlib import resources
from typing import Any, Literal

import numpy as np

FLOOR = {"settling_time": 1e-6, "overshoot": 0.002, "error": 1e-6}  # below this a measure counts as this
NOTHING = {"settling_time": 0.1, "overshoot": 0.005, "error": 0.1}  # smaller changes over a whole curve count as none
THRESHOLD = 0.8  # share of the whole change in one interval, from which on an effect has a threshold


@dataclasses.dataclass(frozen=True, kw_only=True)
class Flown:
    """One training at one value of a parameter, judged; None where too few trials have the measure."""

    seed: int
    settled: int  # trials whose position settled
    settling_time: float | None  # s, median of the position
    overshoot: float | None  # fraction of the step, median of the position
    error: float | None  # m, median of the position
    details: Mapping[str, Any]  # per axis, yaw error, violations, crashes

    def number(self, measure: str, axis: str = "position") -> float:
        """A measure of the position or of an axis, +inf where too few trials have it; x, y and z share its error."""
        if axis == "position" or (measure == "error" and axis != "yaw"):
            value = getattr(self, measure)
        elif measure == "error":
            value = self.details.get("yaw_error")
        else:
            value = self.details.get(f"{measure}_axes", {}).get(axis)
        return math.inf if value is None else float(value)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Point:
    """All trainings at one value of a parameter."""

    value: float
    seeds: Sequence[Flown]

    def numbers(self, measure: str, axis: str = "position") -> list[float]:
        """The measure of each seed, +inf where there is none."""
        return [flown.number(measure, axis) for flown in self.seeds]

    def middle(self, measure: str, axis: str = "position") -> float:
        """The median over seeds."""
        return float(np.median(self.numbers(measure, axis)))

    def apart(self, other: "Point", measure: str, axis: str = "position") -> bool:
        """Whether every seed of one of the two values lies beyond every seed of the other."""
        mine, others = self.numbers(measure, axis), other.numbers(measure, axis)
        return max(mine) < min(others) or max(others) < min(mine)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Curve:
    """What one parameter does: its points in the order of their values."""

    baseline: float
    points: Sequence[Point]

    def around(self, value: float, up: bool = True) -> tuple[Point, Point]:
        """The two measured values between which a parameter moves that leaves `value` upwards, or downwards.

        The outermost two beyond the ends. Values of 0 are left out.
        """
        points = [point for point in self.points if point.value > 0]
        beyond = [point.value > value if up else point.value >= value for point in points]
        upper = beyond.index(True) if True in beyond else len(points) - 1
        upper = max(1, upper)
        return points[upper - 1], points[upper]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Effects:
    """The whole map."""

    facts: Mapping[str, Any]  # command, base task, updates, trials, duration, seeds, versions
    parameters: Mapping[str, Curve]  # field path -> curve

    def elasticity(
        self, path: str, measure: str, value: float, axis: str = "position", up: bool = True
    ) -> float | None:
        """d log(measure) / d log(parameter) between the two values around `value`, of the medians over seeds.

        None where the parameter was not measured, or one of the two has no finite median.
        """
        if path not in self.parameters:
            return None
        low, high = self.parameters[path].around(value, up)
        first, second = (max(point.middle(measure, axis), FLOOR[measure]) for point in (low, high))
        if not (math.isfinite(first) and math.isfinite(second)):
            return None
        return math.log(second / first) / math.log(high.value / low.value)

    def matters(self, path: str, measure: str, value: float, axis: str = "position", up: bool = True) -> bool:
        """Whether the seeds of the two values around `value` are apart; True where the parameter was not measured."""
        if path not in self.parameters:
            return True
        low, high = self.parameters[path].around(value, up)
        return low.apart(high, measure, axis)

    def moves(self, path: str, axis: str = "position") -> bool:
        """Whether the parameter moves anything, somewhere between its first and its last value; True where not measured."""
        if path not in self.parameters:
            return True
        first, *others = self.parameters[path].points
        return any(first.apart(other, measure, axis) for other in others for measure in FLOOR)

    def ahead(self, path: str, value: float, up: bool, other: float) -> bool:
        """Whether a parameter that leaves `value` moves between the same two measured values as from `other`; True where
        it was not measured."""
        if path not in self.parameters:
            return True
        curve = self.parameters[path]
        return curve.around(value, up) == curve.around(other, up)

    def verdict(
        self, path: str, measure: str, direction: Literal["up", "down"], axis: str = "position"
    ) -> Literal["confirmed", "wrong sign", "no effect", "only beyond a threshold"]:
        """What became of the claim that raising the parameter moves the measure in `direction`, from the whole curve.

        No effect: from the first to the last value with a finite median the measure changes by less than 10 % (0.005
        for the overshoot), or the seeds of the two are not apart. Only beyond a threshold: one interval between
        neighbours carries at least 80 % of the change. A value where nothing settles is left out.
        """
        points = [point for point in self.parameters[path].points if math.isfinite(point.middle(measure, axis))]
        if len(points) < 2:
            return "no effect"
        middles = [point.middle(measure, axis) for point in points]
        change = middles[-1] - middles[0]
        least = NOTHING[measure] * (1.0 if measure == "overshoot" else min(middles))
        if abs(change) < least or not points[0].apart(points[-1], measure, axis):
            return "no effect"
        if (change > 0) != (direction == "up"):
            return "wrong sign"
        steps = np.diff(middles) / change
        return "only beyond a threshold" if len(steps) > 1 and steps.max() >= THRESHOLD else "confirmed"


def load_effects() -> Effects:
    """The map that ships with flytune, made by `python benchmarks/effect_map.py`."""
    return read_effects((resources.files("flytune.tuning") / "sensitivity.json").read_text(encoding="utf-8"))


def read_effects(text: str) -> Effects:
    """The map of a JSON text."""
    told = json.loads(text)
    named = ("seed", "settled", "settling_time", "overshoot", "error")

    def flown(row: dict[str, Any]) -> Flown:
        details = {name: value for name, value in row.items() if name not in named}
        return Flown(**{name: row[name] for name in named}, details=details)

    parameters = {
        path: Curve(
            baseline=curve["baseline"],
            points=[
                Point(value=point["value"], seeds=[flown(row) for row in point["seeds"]]) for point in curve["points"]
            ],
        )
        for path, curve in told["parameters"].items()
    }
    return Effects(facts={name: value for name, value in told.items() if name != "parameters"}, parameters=parameters)
