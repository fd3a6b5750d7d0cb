"""Slopes d log(measure) / d log(field), from the iterations so far, the measured sensitivities, or the rule itself."""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Any

from flytune.tuning.iteration import SAME, Iteration, variants
from flytune.tuning.requirement import Requirement
from flytune.tuning.rules import Rule
from flytune.tuning.sensitivity import Sensitivities

WEAK = 0.25  # a slope between iterations is ignored below this share of the measured sensitivity
MEASURES = ("settling_time", "overshoot", "error")  # those with measured sensitivities


@dataclasses.dataclass(frozen=True)
class Context:
    """Everything that the choice of an edit depends on; `choose` explains each field."""

    iterations: Sequence[Iteration]
    tables: Mapping[str, Any]
    requirement: Requirement
    rules: Sequence[Rule]
    sensitivities: Sensitivities
    fixed: Sequence[str]
    trainer: str

    @property
    def same_trainer(self) -> bool:
        """Whether the sensitivities were measured with this trainer; only then they can rule an edit out."""
        return self.trainer == self.sensitivities.facts["trainer"]


@dataclasses.dataclass(frozen=True)
class Slope:
    """How a measure depends on a field: measure ~ field^power."""

    power: float  # d log(measure) / d log(field)
    known_from: str  # iterations, interpolation, sensitivity or rule
    between: tuple[float, float] | None  # values of the field that it was measured between


def find_slope(context: Context, rule: Rule, value: float, iteration: Iteration) -> Slope | str:
    """The slope of the rule's measure at a value of its field; or the reason why the rule does not apply there."""
    up = rule.direction == "up"
    known, what = context.sensitivities, (rule.field, rule.measure, value, context.requirement.axis, up)
    sensitivity = known.slope(*what) if rule.measure in MEASURES else None
    holds = sensitivity is not None and sensitivity * rule.slope > 0 and known.is_significant(*what)
    found = []
    for other, there in variants(iteration, rule.field, context.iterations):
        if other is iteration or abs(math.log(there / value)) < SAME:
            continue
        now, then = (getattr(each.response, rule.measure) for each in (iteration, other))
        if now > 0 and then > 0 and math.isfinite(now) and math.isfinite(then):
            found.append((abs(math.log(there / value)), math.log(then / now) / math.log(there / value), there))
    if found:
        _, power, there = min(found)
        # a weak slope on this side of a known threshold predicts nothing beyond the threshold
        weak = holds and sensitivity is not None and abs(power) < WEAK * abs(sensitivity)
        usable = not weak or known.same_interval(rule.field, value, up, there)
        if usable and power * rule.slope > 0 and abs(power) > 0.1 * abs(float(rule.slope)):
            return Slope(power, "iterations", (value, there))
    if holds and sensitivity is not None:
        low, high = known.parameters[rule.field].interval(value, up)
        return Slope(sensitivity, "sensitivity", (low.value, high.value))
    if sensitivity is None or not context.same_trainer:
        return Slope(float(rule.slope), "rule", None)
    return f"its measured effect there is {'opposite' if known.is_significant(*what) else 'zero'}"


def interpolated(
    context: Context, rule: Rule, iteration: Iteration, value: float, wanted: float, slope: Slope
) -> Slope:
    """The slope that leads to a value between a slower and a faster iteration, where both exist; else `slope`.

    A slope that was measured from an iteration on the other side of `value` stays if it already leads between the two.

    Args:
        context: what the choice depends on.
        rule: the rule that is used.
        iteration: the iteration to edit.
        value: the field's value in it.
        wanted: d log(measure) that is wanted.
        slope: the slope found so far.
    """
    bracket = None
    if rule.measure == "settling_time":
        bracket = _bracket(rule, iteration, context.iterations, context.requirement.aim())
    if bracket is None:
        return slope
    slow, fast, share = bracket
    goal = slow + share * (fast - slow)
    change = wanted / slope.power
    inside = 0.05 < (math.log(value) + change - slow) / (fast - slow) < 0.95
    behind = (
        slope.known_from == "iterations"
        and slope.between is not None
        and math.log(slope.between[1] / value) * change < 0
    )
    if (behind and inside) or abs(goal - math.log(value)) < 1e-9:
        return slope
    return Slope(wanted / (goal - math.log(value)), "interpolation", (math.exp(slow), math.exp(fast)))


def _bracket(
    rule: Rule, iteration: Iteration, iterations: Sequence[Iteration], aim: float
) -> tuple[float, float, float] | None:
    """The log of the field in the nearest slower and faster iterations, and the share of the way from one to the other.

    None where one of the two does not exist. An end that stays while further iterations fall on the other side is
    weighted half as much each time. Without this, a curved relation would be followed in ever smaller edits (the
    Illinois variant of the false position method).

    Source: Dowell and Jarratt 1971, A modified regula falsi method for computing the root of an equation.
    """
    around = [
        (math.log(each.response.settling_time / aim), math.log(there), each.number)
        for each, there in variants(iteration, rule.field, iterations)
        if math.isfinite(each.response.settling_time) and each.response.settling_time > 0
    ]
    slower, faster = [point for point in around if point[0] > 0], [point for point in around if point[0] <= 0]
    if not slower or not faster:
        return None
    (late, slow, _), (early, fast, _) = ends = min(slower), max(faster)
    stays = [sum(each[2] > end[2] for each in others) - 1 for end, others in zip(ends, (faster, slower), strict=True)]
    late, early = (off * 0.5 ** max(0, count) for off, count in zip((late, early), stays, strict=True))
    return slow, fast, max(0.1, min(0.9, late / (late - early)))
