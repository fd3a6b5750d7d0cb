"""The requirement on a response, and how far a measured response is from it."""

import dataclasses
import math
from collections.abc import Callable, Collection, Mapping
from typing import Any, Literal, Self

import numpy as np

from flytune.evaluation.judge import Judgement
from flytune.evaluation.statistics import quantile
from flytune.task.task import Task

AXES = ("position", "x", "y", "z", "yaw")
LARGEST_MISS = 20.0  # also where the measure is infinite
TRAINING_TOLERANCE, TRAINING_BOUNDS = 0.5, 0.8  # on the training set, as shares of those on a validation set


@dataclasses.dataclass(frozen=True, kw_only=True)
class ResponseSummary:
    """One number per measure of a judged response, +inf where too few trials have one.

    Where several axes are asked for, it is that of the axis that misses its requirement most.

    Source: docs/concepts/definitions.md.
    """

    settling_time: float  # s, at the percentile asked for
    overshoot: float  # fraction of the step, median
    error: float  # m, rad for yaw; median
    settled: float  # share of the trials, on all axes asked for
    constraints_satisfied: float  # share of the feasible trials that violate no constraint of the user
    axes: Mapping[str, str] = dataclasses.field(default_factory=dict)  # measure -> its axis, where not the leading one
    # measure -> axis -> its number, where several axes are asked for
    each: Mapping[str, Mapping[str, float]] = dataclasses.field(default_factory=dict)

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers, None where infinite."""
        return _replaced(dataclasses.asdict(self), math.inf, None)

    @classmethod
    def from_dict(cls, numbers: dict[str, Any]) -> "ResponseSummary":
        """The summary that `to_dict` has written."""
        return cls(**_replaced(numbers, None, math.inf))


def _replaced(numbers: Any, old: float | None, new: float | None) -> Any:
    """Nested tables with one value in the place of another."""
    if isinstance(numbers, dict):
        return {name: _replaced(value, old, new) for name, value in numbers.items()}
    return new if numbers == old else numbers


NO_RESPONSE = ResponseSummary(
    settling_time=math.inf, overshoot=math.inf, error=math.inf, settled=0.0, constraints_satisfied=0.0
)


@dataclasses.dataclass(frozen=True, kw_only=True)
class AxisLimits:
    """What one axis, or the position, may show at most."""

    axis: str = "position"
    overshoot: float = 0.05  # at most, fraction of the step, median of the trials
    error: float = 0.01  # at most, m (rad for yaw), median of the trials
    percentile: float = 50.0  # of the trials, for the settling time

    def tightened(self) -> Self:
        """The limits on the training set: 80 % of the bounds."""
        return dataclasses.replace(self, overshoot=TRAINING_BOUNDS * self.overshoot, error=TRAINING_BOUNDS * self.error)

    def __str__(self) -> str:
        error = f"{math.degrees(self.error):.3g} deg" if self.axis == "yaw" else f"{1e3 * self.error:.3g} mm"
        return f"overshoot at most {100 * self.overshoot:g} %, error at most {error}"

    @property
    def trial(self) -> str:
        """Which trial the settling time is taken of."""
        return "median trial" if self.percentile == 50 else f"percentile {self.percentile:g} of the trials"


@dataclasses.dataclass(frozen=True, kw_only=True)
class Requirement(AxisLimits):
    """The wanted response of one axis or of the position, and what further axes may show at most.

    The settling time is that of the leading axis, `axis`. The `others` settle no later.
    """

    settling_time: float  # s
    tolerance: float = 0.1  # allowed deviation, as a share of the settling time
    at_most: bool = False  # the settling time is an upper bound, not a target
    settled: float = 0.99  # at least, share of the trials
    others: tuple[AxisLimits, ...] = ()

    def limits(self, axis: str) -> AxisLimits:
        """The limits of an axis that is asked for."""
        return next((each for each in self.others if each.axis == axis), self)

    def axis_of(self, measure: str, response: ResponseSummary) -> str:
        """The axis that a measure of a response belongs to."""
        return response.axes.get(measure, self.axis)

    def limit(self, measure: Literal["overshoot", "error"], response: ResponseSummary) -> float:
        """The bound of a measure on the axis that the response has it of."""
        return getattr(self.limits(self.axis_of(measure, response)), measure)

    def maximum_settling_time(self) -> float:
        """The longest settling time in s that still meets the requirement."""
        return self.settling_time * (1.0 if self.at_most else 1.0 + self.tolerance)

    def tightened(self) -> Self:
        """The requirement on the training set: half of the tolerance and 80 % of the bounds.

        A policy that meets it usually meets the requirement itself on other initial conditions too.
        """
        tolerance = TRAINING_TOLERANCE * self.tolerance
        return dataclasses.replace(
            super().tightened(),
            settling_time=self.settling_time * (1.0 - tolerance if self.at_most else 1.0),
            tolerance=tolerance,
            others=tuple(each.tightened() for each in self.others),
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

        asked: tuple[AxisLimits, ...] = (self, *self.others)
        times = {each.axis: all_of(lambda judged, axis=each.axis: judged.settling_time[axis]) for each in asked}
        measured: dict[str, dict[str, float]] = {"settling_time": {}, "overshoot": {}, "error": {}}
        for each in asked:
            stepped = all_of(lambda judged, axis=each.axis: judged.overshoot[axis])
            stepped = stepped[~np.isnan(stepped)]
            errors = all_of(lambda judged, axis=each.axis: judged.steady_state_error[axis])
            measured["settling_time"][each.axis] = _quantile(times[each.axis], each.percentile / 100)
            measured["overshoot"][each.axis] = _quantile(stepped, 0.5) if stepped.size else 0.0
            measured["error"][each.axis] = _quantile(errors, 0.5)
        axes = {measure: self._worst_axis(measure, values) for measure, values in measured.items()}
        feasible = ~all_of(lambda judged: judged.infeasible)
        crossed = [all_of(lambda judged, name=name: judged.violated[name]) for name in constraints]
        broken = np.logical_or.reduce([np.zeros(len(feasible), bool), *crossed])
        return ResponseSummary(
            **{measure: values[axes[measure]] for measure, values in measured.items()},
            settled=float(np.mean(np.logical_and.reduce([np.isfinite(each) for each in times.values()]))),
            constraints_satisfied=float(1 - np.mean(broken[feasible])) if feasible.any() else 1.0,
            axes={measure: axis for measure, axis in axes.items() if axis != self.axis},
            each=measured if self.others else {},
        )

    def _worst_axis(self, measure: str, values: Mapping[str, float]) -> str:
        """The axis that exceeds its bound of a measure most; the leading one where none does."""
        if measure == "settling_time":
            late = [axis for axis, value in values.items() if value > self.maximum_settling_time()]
            return max(late, key=lambda axis: values[axis], default=self.axis)
        excess = {axis: values[axis] / max(getattr(self.limits(axis), measure), 1e-3) for axis in values}
        worst = max(excess, key=lambda axis: excess[axis])
        return worst if values[worst] > getattr(self.limits(worst), measure) else self.axis

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
        if (excess := response.overshoot - self.limit("overshoot", response)) > 0:
            found["overshoot"] = min(excess, LARGEST_MISS)
        if response.error > (most := self.limit("error", response)):
            found["error"] = _log(response.error / most)
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
        tolerance = f"+- {100 * self.tolerance:g} %"
        time = f"at most {self.settling_time:g} s" if self.at_most else f"{self.settling_time:g} s {tolerance}"
        text = (
            f"{self.axis} settles in {time} ({self.trial}), {super().__str__()} (both in the median), "
            f"{100 * self.settled:g} % of the trials settle"
        )
        others = (f"; {each.axis} settles no later ({each.trial}), {each}" for each in self.others)
        return text + "".join(others)


def constraints_of(task: Task, edits: Collection[str]) -> tuple[str, ...]:
    """The names of the terminations of a task that the user has set, whole or in part."""
    return tuple(
        name
        for name in task.termination
        if any(f"{path}.".startswith(f"termination.{name}.") or path == "termination" for path in edits)
    )


def _log(ratio: float) -> float:
    return LARGEST_MISS if math.isinf(ratio) else max(-LARGEST_MISS, min(LARGEST_MISS, math.log(max(ratio, 1e-6))))


def _quantile(values: np.ndarray, share: float) -> float:
    found = quantile(values, share)
    return math.inf if found is None else found
