"""What is asked of a response, and how far a measured one is from it."""

import dataclasses
import math
from collections.abc import Callable
from typing import Any

import numpy as np

from flytune.errors import BadInput
from flytune.evaluation.judge import Judgement
from flytune.evaluation.statistics import quantile

AXES = ("position", "x", "y", "z", "yaw")
LONGEST = 60.0  # s
FAR = 20.0  # the largest miss there is, also where the measure is infinite
TUNING_TOLERANCE, TUNING_BOUNDS = 0.5, 0.8  # shares of what is allowed on fresh starts that the tuning starts may take


@dataclasses.dataclass(frozen=True, kw_only=True)
class Measured:
    """What counts of a judged response: one number per measure, +inf where too few trials have one.

    Source: docs, definitions.
    """

    settling_time: float  # s, at the percentile asked for
    overshoot: float  # fraction of the step, median
    error: float  # m, rad for yaw; median
    settled: float  # share of the trials
    kept: float  # share of the trials that cross none of the bounds the user has fixed

    def to_dict(self) -> dict[str, float | None]:
        """Plain numbers, None where infinite."""
        return {name: v if math.isfinite(v) else None for name, v in dataclasses.asdict(self).items()}

    @classmethod
    def from_dict(cls, numbers: dict[str, Any]) -> "Measured":
        """The inverse of `to_dict`."""
        return cls(**{name: math.inf if value is None else value for name, value in numbers.items()})


@dataclasses.dataclass(frozen=True, kw_only=True)
class Requirement:
    """The response that is wanted, of one axis or of the position."""

    settling_time: float  # s
    tolerance: float = 0.1  # share of the settling time it may be off by; only above it where `at_most`
    at_most: bool = False  # the settling time is an upper bound, not a target
    overshoot: float = 0.05  # at most, fraction of the step, median of the trials
    error: float = 0.01  # at most, m (rad for yaw), median of the trials
    settled: float = 0.99  # at least, share of the trials
    axis: str = "position"
    percentile: float = 50.0  # of the trials, for the settling time

    def latest(self) -> float:
        """The longest settling time in s that still meets the requirement."""
        return self.settling_time * (1.0 if self.at_most else 1.0 + self.tolerance)

    def narrowed(self) -> "Requirement":
        """What is asked on the tuning starts, so that fresh ones rarely disappoint: half of the tolerance, 80 % of the
        bounds; `settled` as it is."""
        tolerance = TUNING_TOLERANCE * self.tolerance
        return dataclasses.replace(
            self,
            settling_time=self.settling_time * (1.0 - tolerance if self.at_most else 1.0),
            tolerance=tolerance,
            overshoot=TUNING_BOUNDS * self.overshoot,
            error=TUNING_BOUNDS * self.error,
        )

    def aim(self) -> float:
        """The settling time in s to steer for."""
        return self.settling_time * (1.0 - self.tolerance / 2 if self.at_most else 1.0)

    def measure(self, *judgements: Judgement, fixed: tuple[str, ...] = ()) -> Measured:
        """The measures of all the trials of one or more judgements; `fixed` names the terminations the user has set."""

        def all_of(values: Callable[[Judgement], np.ndarray]) -> np.ndarray:
            return np.concatenate([values(judgement) for judgement in judgements])

        times = all_of(lambda judged: judged.settling_time[self.axis])
        stepped = all_of(lambda judged: judged.overshoot[self.axis])
        stepped = stepped[~np.isnan(stepped)]
        feasible = ~all_of(lambda judged: judged.infeasible)
        crossed = [all_of(lambda judged, name=name: judged.violated[name]) for name in fixed]
        broken = np.logical_or.reduce([np.zeros(len(times), bool), *crossed])
        return Measured(
            settling_time=_quantile(times, self.percentile / 100),
            overshoot=_quantile(stepped, 0.5) if stepped.size else 0.0,
            error=_quantile(all_of(lambda judged: judged.steady_state_error[self.axis]), 0.5),
            settled=float(np.mean(np.isfinite(times))),
            kept=float(1 - np.mean(broken[feasible])) if feasible.any() else 1.0,
        )

    def misses(self, measured: Measured) -> dict[str, float]:
        """What is missing: measure -> by how much, as a logarithm for the settling time and a share for the others.

        Positive means too much, negative too little; at most `FAR`. Empty where the requirement is met.
        """
        found: dict[str, float] = {}
        if measured.settled < self.settled:
            found["settled"] = measured.settled - self.settled
        if measured.kept < self.settled:
            found["kept"] = measured.kept - self.settled
        ratio = measured.settling_time / self.settling_time
        if measured.settling_time > self.latest() or (not self.at_most and ratio < 1 - self.tolerance):
            found["settling_time"] = _log(measured.settling_time / self.aim())
        if measured.overshoot > self.overshoot:
            found["overshoot"] = min(measured.overshoot - self.overshoot, FAR)
        if measured.error > self.error:
            found["error"] = _log(measured.error / self.error)
        return found

    def parts(self, measured: Measured) -> dict[str, float]:
        """How far a response is from the requirement, by measure; empty where it is met.

        In units that can be added: 1 is a settling time off by a factor of e, a fifth of the trials that do not
        settle or break a bound, a fifth of the step too much overshoot, or an error too large by a factor of e^2.
        """
        sizes = {"settled": 5.0, "kept": 5.0, "settling_time": 1.0, "overshoot": 5.0, "error": 0.5}
        return {name: sizes[name] * min(abs(size), 10.0) for name, size in self.misses(measured).items()}

    def distance(self, measured: Measured) -> float:
        """One number for how far a response is from the requirement, 0 where it is met: to find the best of several."""
        return sum(self.parts(measured).values())

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers."""
        return dataclasses.asdict(self)

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
    """A requirement from the numbers a user gives.

    Args:
        settling_time: s.
        overshoot: at most, percent of the step.
        error: steady-state error at most, m; deg for yaw. 0.01 m or 1 deg where None.
        at_most: the settling time is an upper bound, not a target.
        tolerance: percent of the settling time.
        axis: position, x, y, z or yaw.
        percentile: of the trials that the settling time is of.

    Raises:
        BadInput: a number that is not possible, or that seems to be in another unit.
    """
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
    unit, smallest, largest = ("deg", 0.02, 3.6) if axis == "yaw" else ("m", 0.0002, 0.02)
    if error is None:
        error = 1.0 if axis == "yaw" else 0.01
    millimetres = axis != "yaw" and 1 <= error <= 20
    hint = f" Did you mean {error / 1000:g} (metres, not millimetres)?" if millimetres else ""
    if error > largest:
        hint = hint or f" Beyond {largest:g} {unit} a trial does not count as settled."
    _check("error", error, smallest, largest, unit, hint)
    _check("tolerance", tolerance, 2.0, 50.0, "%", f" Did you mean {100 * tolerance:g}?" if 0 < tolerance < 1 else "")
    _check(
        "percentile", percentile, 1.0, 99.0, "%", f" Did you mean {100 * percentile:g}?" if 0 < percentile < 1 else ""
    )
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
    return FAR if math.isinf(ratio) else max(-FAR, min(FAR, math.log(max(ratio, 1e-6))))


def _quantile(values: np.ndarray, share: float) -> float:
    found = quantile(values, share)
    return math.inf if found is None else found


def _check(name: str, value: float, smallest: float, largest: float, unit: str, hint: str = "") -> None:
    if not (math.isfinite(value) and smallest <= value <= largest):
        raise BadInput(f"{name}: {value:g} is not allowed. Allowed: {smallest:g} to {largest:g} {unit}.{hint}")
