"""The requirement on a response, and how far a measured response is from it."""

import dataclasses
import math
from collections.abc import Callable, Collection
from typing import Any

import numpy as np

from flytune.errors import BadInput
from flytune.evaluation.judge import Judgement
from flytune.evaluation.metrics import POSITION_BAND, YAW_BAND
from flytune.evaluation.statistics import quantile
from flytune.task.task import Task

AXES = ("position", "x", "y", "z", "yaw")
LONGEST = 60.0  # s
LARGEST_MISS = 20.0  # also where the measure is infinite
TRAINING_TOLERANCE, TRAINING_BOUNDS = 0.5, 0.8  # on the training set, as shares of those on a validation set


@dataclasses.dataclass(frozen=True, kw_only=True)
class ResponseSummary:
    """One number per measure of a judged response, +inf where too few trials have one.

    Source: docs/concepts/definitions.md.
    """

    settling_time: float  # s, at the percentile asked for
    overshoot: float  # fraction of the step, median
    error: float  # m, rad for yaw; median
    settled: float  # share of the trials
    constraints_satisfied: float  # share of the feasible trials that violate no constraint of the user

    def to_dict(self) -> dict[str, float | None]:
        """Plain numbers, None where infinite."""
        return {name: v if math.isfinite(v) else None for name, v in dataclasses.asdict(self).items()}

    @classmethod
    def from_dict(cls, numbers: dict[str, Any]) -> "ResponseSummary":
        """The summary that `to_dict` has written."""
        return cls(**{name: math.inf if value is None else value for name, value in numbers.items()})


NO_RESPONSE = ResponseSummary(
    settling_time=math.inf, overshoot=math.inf, error=math.inf, settled=0.0, constraints_satisfied=0.0
)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Requirement:
    """The wanted response of one axis or of the position."""

    settling_time: float  # s
    tolerance: float = 0.1  # allowed deviation, as a share of the settling time
    at_most: bool = False  # the settling time is an upper bound, not a target
    overshoot: float = 0.05  # at most, fraction of the step, median of the trials
    error: float = 0.01  # at most, m (rad for yaw), median of the trials
    settled: float = 0.99  # at least, share of the trials
    axis: str = "position"
    percentile: float = 50.0  # of the trials, for the settling time

    def maximum_settling_time(self) -> float:
        """The longest settling time in s that still meets the requirement."""
        return self.settling_time * (1.0 if self.at_most else 1.0 + self.tolerance)

    def tightened(self) -> "Requirement":
        """The requirement on the training set: half of the tolerance and 80 % of the bounds.

        A policy that meets it usually meets the requirement itself on other initial conditions too.
        """
        tolerance = TRAINING_TOLERANCE * self.tolerance
        return dataclasses.replace(
            self,
            settling_time=self.settling_time * (1.0 - tolerance if self.at_most else 1.0),
            tolerance=tolerance,
            overshoot=TRAINING_BOUNDS * self.overshoot,
            error=TRAINING_BOUNDS * self.error,
        )

    def aim(self) -> float:
        """The settling time in s that an edit aims at."""
        return self.settling_time * (1.0 - self.tolerance / 2 if self.at_most else 1.0)

    def trial_duration(self) -> float:
        """The duration of a trial in s: 2.5 times the settling time, and at least 10 s."""
        return float(math.ceil(max(10.0, 2.5 * self.settling_time)))

    def measure(self, *judgements: Judgement, constraints: tuple[str, ...] = ()) -> ResponseSummary:
        """The summary over all trials of some judgements; `constraints` names the terminations the user has set."""

        def all_of(values: Callable[[Judgement], np.ndarray]) -> np.ndarray:
            return np.concatenate([values(judgement) for judgement in judgements])

        times = all_of(lambda judged: judged.settling_time[self.axis])
        stepped = all_of(lambda judged: judged.overshoot[self.axis])
        stepped = stepped[~np.isnan(stepped)]
        feasible = ~all_of(lambda judged: judged.infeasible)
        crossed = [all_of(lambda judged, name=name: judged.violated[name]) for name in constraints]
        broken = np.logical_or.reduce([np.zeros(len(times), bool), *crossed])
        return ResponseSummary(
            settling_time=_quantile(times, self.percentile / 100),
            overshoot=_quantile(stepped, 0.5) if stepped.size else 0.0,
            error=_quantile(all_of(lambda judged: judged.steady_state_error[self.axis]), 0.5),
            settled=float(np.mean(np.isfinite(times))),
            constraints_satisfied=float(1 - np.mean(broken[feasible])) if feasible.any() else 1.0,
        )

    def misses(self, response: ResponseSummary) -> dict[str, float]:
        """Measure -> by how much it misses its bound; empty where the requirement is met.

        The logarithm of a ratio for the settling time and the error, a difference of shares for the others. Positive
        means too much, negative too little. No miss exceeds `LARGEST_MISS`.
        """
        found: dict[str, float] = {}
        if response.settled < self.settled:
            found["settled"] = response.settled - self.settled
        if response.constraints_satisfied < self.settled:
            found["constraints_satisfied"] = response.constraints_satisfied - self.settled
        ratio = response.settling_time / self.settling_time
        if response.settling_time > self.maximum_settling_time() or (not self.at_most and ratio < 1 - self.tolerance):
            found["settling_time"] = _log(response.settling_time / self.aim())
        if response.overshoot > self.overshoot:
            found["overshoot"] = min(response.overshoot - self.overshoot, LARGEST_MISS)
        if response.error > self.error:
            found["error"] = _log(response.error / self.error)
        return found

    def weighted_misses(self, response: ResponseSummary) -> dict[str, float]:
        """Measure -> its miss in units that can be added; empty where the requirement is met.

        1 is a settling time off by a factor of e, a fifth of the trials that do not settle or violate a constraint, a
        fifth of the step too much overshoot, or an error too large by a factor of e^2.
        """
        sizes = {"settled": 5.0, "constraints_satisfied": 5.0, "settling_time": 1.0, "overshoot": 5.0, "error": 0.5}
        return {name: sizes[name] * min(abs(size), 10.0) for name, size in self.misses(response).items()}

    def distance(self, response: ResponseSummary) -> float:
        """Sum of the weighted misses, 0 where the requirement is met."""
        return sum(self.weighted_misses(response).values())

    def __str__(self) -> str:
        degrees = self.axis == "yaw"
        error = f"{math.degrees(self.error):.3g} deg" if degrees else f"{1e3 * self.error:.3g} mm"
        tolerance = f"+- {100 * self.tolerance:g} %"
        time = f"at most {self.settling_time:g} s" if self.at_most else f"{self.settling_time:g} s {tolerance}"
        name = "median trial" if self.percentile == 50 else f"percentile {self.percentile:g} of the trials"
        return (
            f"{self.axis} settles in {time} ({name}), overshoot at most {100 * self.overshoot:g} %, "
            f"error at most {error} (both in the median), {100 * self.settled:g} % of the trials settle"
        )


def constraints_of(task: Task, edits: Collection[str]) -> tuple[str, ...]:
    """The names of the terminations of a task that the user has set, whole or in part."""
    return tuple(
        name
        for name in task.termination
        if any(f"{path}.".startswith(f"termination.{name}.") or path == "termination" for path in edits)
    )


def make_requirement(
    settling_time: float,
    overshoot: float = 5.0,
    error: float | None = None,
    *,
    at_most: bool = False,
    tolerance: float = 10.0,
    axis: str = "position",
    percentile: float = 50.0,
) -> Requirement:
    """The requirement in the units of the judge, from numbers in the units of the command line.

    Args:
        settling_time: wanted settling time in s.
        overshoot: largest allowed median overshoot in percent of the step.
        error: largest allowed median steady-state error in m, in deg for yaw; 0.01 m or 1 deg where None.
        at_most: the settling time is an upper bound, not a target.
        tolerance: allowed deviation from the settling time in percent.
        axis: position, x, y, z or yaw.
        percentile: percentile of the trials at which the settling time is taken.

    Raises:
        BadInput: a number is out of range, or seems to be in another unit.
    """

    def fraction_hint(value: float) -> str:
        return f" Did you mean {100 * value:g}?" if 0 < value < 1 else ""

    if axis not in AXES:
        raise BadInput(f"axis: {axis!r} is not allowed. Allowed: {', '.join(AXES)}.")
    hint = f" Did you mean {settling_time / 1000:g} (seconds, not milliseconds)?" if settling_time >= 200 else ""
    _check("settling-time", settling_time, 0.2, LONGEST, "s", hint)
    if 0 < overshoot < 0.5:
        raise BadInput(
            f"overshoot: {overshoot:g} is not allowed. Allowed: 0, or 0.5 to 100 %. "
            f"Did you mean {100 * overshoot:g} (percent of the step, not a fraction)?"
        )
    _check("overshoot", overshoot, 0.0, 100.0, "%")
    band = math.degrees(YAW_BAND) if axis == "yaw" else POSITION_BAND
    unit, smallest, largest = ("deg", 0.02, round(band, 9)) if axis == "yaw" else ("m", 0.0002, band)
    if error is None:
        error = 1.0 if axis == "yaw" else 0.01
    millimetres = axis != "yaw" and 1 <= error <= 20
    hint = f" Did you mean {error / 1000:g} (metres, not millimetres)?" if millimetres else ""
    if error > largest:
        hint = hint or f" Beyond {largest:g} {unit} a trial does not count as settled."
    _check("error", error, smallest, largest, unit, hint)
    _check("tolerance", tolerance, 2.0, 50.0, "%", fraction_hint(tolerance))
    _check("percentile", percentile, 1.0, 99.0, "%", fraction_hint(percentile))
    return Requirement(
        settling_time=float(settling_time),
        tolerance=tolerance / 100,
        at_most=at_most,
        overshoot=overshoot / 100,
        error=math.radians(error) if axis == "yaw" else float(error),
        axis=axis,
        percentile=float(percentile),
    )


def _log(ratio: float) -> float:
    return LARGEST_MISS if math.isinf(ratio) else max(-LARGEST_MISS, min(LARGEST_MISS, math.log(max(ratio, 1e-6))))


def _quantile(values: np.ndarray, share: float) -> float:
    found = quantile(values, share)
    return math.inf if found is None else found


def _check(name: str, value: float, smallest: float, largest: float, unit: str, hint: str = "") -> None:
    if not (math.isfinite(value) and smallest <= value <= largest):
        raise BadInput(f"{name}: {value:g} is not allowed. Allowed: {smallest:g} to {largest:g} {unit}.{hint}")
