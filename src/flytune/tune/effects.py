"""The effect map: what each knob of a task was measured to do to the response, other knobs as in baseline-refined."""

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
    """One training at one value of a knob, judged; None where too few trials have the measure."""

    seed: int
    settled: int  # trials whose position settled
    settling_time: float | None  # s, median of the position
    overshoot: float | None  # fraction of the step, median of the position
    error: float | None  # m, median of the position
    details: Mapping[str, Any]  # per axis, yaw error, violations, crashes


@dataclasses.dataclass(frozen=True, kw_only=True)
class Point:
    """All trainings at one value of a knob."""

    value: float
    seeds: Sequence[Flown]

    def numbers(self, measure: str) -> list[float]:
        """The measure of each seed, +inf where there is none."""
        found = (getattr(flown, measure) for flown in self.seeds)
        return [math.inf if value is None else float(value) for value in found]

    def middle(self, measure: str) -> float:
        """The median over seeds."""
        return float(np.median(self.numbers(measure)))

    def spread(self, measure: str) -> float:
        """Largest less smallest over seeds, +inf where a seed has none."""
        numbers = self.numbers(measure)
        return max(numbers) - min(numbers) if all(map(math.isfinite, numbers)) else math.inf


@dataclasses.dataclass(frozen=True, kw_only=True)
class Curve:
    """What one knob does: its points in the order of their values."""

    baseline: float
    points: Sequence[Point]

    def around(self, value: float) -> tuple[Point, Point]:
        """The two measured values that bracket a value; the outermost two beyond the ends. Values of 0 are left out."""
        points = [point for point in self.points if point.value > 0]
        upper = next((index for index, point in enumerate(points) if point.value > value), len(points) - 1)
        upper = max(1, upper)
        return points[upper - 1], points[upper]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Effects:
    """The whole map."""

    facts: Mapping[str, Any]  # command, base task, updates, trials, duration, seeds, versions
    knobs: Mapping[str, Curve]  # field path -> curve

    def elasticity(self, path: str, measure: str, value: float) -> float | None:
        """d log(measure) / d log(knob) between the two measured values around `value`, of the medians over seeds.

        None where the knob was not measured, or one of the two has no finite median.
        """
        if path not in self.knobs:
            return None
        low, high = self.knobs[path].around(value)
        first, second = (max(point.middle(measure), FLOOR[measure]) for point in (low, high))
        if not (math.isfinite(first) and math.isfinite(second)):
            return None
        return math.log(second / first) / math.log(high.value / low.value)

    def matters(self, path: str, measure: str, value: float) -> bool:
        """Whether the two medians around `value` are farther apart than the seeds of either; True where unmeasured."""
        if path not in self.knobs:
            return True
        low, high = self.knobs[path].around(value)
        change = abs(high.middle(measure) - low.middle(measure))
        return change > max(low.spread(measure), high.spread(measure))

    def verdict(
        self, path: str, measure: str, direction: Literal["up", "down"]
    ) -> Literal["confirmed", "wrong sign", "no effect", "only beyond a threshold"]:
        """What became of the claim that raising the knob moves the measure in `direction`, from the whole curve.

        No effect: from the first to the last value with a finite median the measure changes by less than 10 % (0.005
        for the overshoot), or by less than the seeds differ. Only beyond a threshold: one interval between neighbours
        carries at least 80 % of the change. A value where nothing settles is left out.
        """
        points = [point for point in self.knobs[path].points if math.isfinite(point.middle(measure))]
        if len(points) < 2:
            return "no effect"
        middles = [point.middle(measure) for point in points]
        change = middles[-1] - middles[0]
        least = NOTHING[measure] * (1.0 if measure == "overshoot" else min(middles))
        if abs(change) < max(least, points[0].spread(measure), points[-1].spread(measure)):
            return "no effect"
        if (change > 0) != (direction == "up"):
            return "wrong sign"
        steps = np.diff(middles) / change
        return "only beyond a threshold" if len(steps) > 1 and steps.max() >= THRESHOLD else "confirmed"


def load_effects() -> Effects:
    """The map that ships with flytune, made by `python benchmarks/effect_map.py`."""
    return read_effects((resources.files("flytune.tune") / "effects.json").read_text(encoding="utf-8"))


def read_effects(text: str) -> Effects:
    """The map of a JSON text."""
    told = json.loads(text)
    named = ("seed", "settled", "settling_time", "overshoot", "error")

    def flown(row: dict[str, Any]) -> Flown:
        details = {name: value for name, value in row.items() if name not in named}
        return Flown(**{name: row[name] for name in named}, details=details)

    knobs = {
        path: Curve(
            baseline=curve["baseline"],
            points=[
                Point(value=point["value"], seeds=[flown(row) for row in point["seeds"]]) for point in curve["points"]
            ],
        )
        for path, curve in told["knobs"].items()
    }
    return Effects(facts={name: value for name, value in told.items() if name != "knobs"}, knobs=knobs)
