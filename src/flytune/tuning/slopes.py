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


class NotUsed(Exception):
    """Why a rule is not used on an iteration."""


@dataclasses.dataclass(frozen=True)
class Context:
    """Everything that the choice of an edit depends on."""

    iterations: Sequence[Iteration]  # all so far; the first one is the start
    tables: Mapping[str, Any]  # the task of the start, as nested tables
    requirement: Requirement  # on the training set
    rules: Sequence[Rule]  # that may be used
    sensitivities: Sensitivities
    fixed: Sequence[str]  # field paths that the user has set; they, and all fields below them, are not edited
    trainer: str  # its name; rules for settings of other trainers are left out

    @property
    def same_trainer(self) -> bool:
        """Whether the sensitivities were measured with this trainer; only then they can rule an edit out."""
        return self.trainer == self.sensitivities.facts["trainer"]

    def axis_of(self, measure: str, iteration: Iteration) -> str:
        """The axis that a measure of an iteration belongs to."""
        return self.requirement.axis_of(measure, iteration.response)


@dataclasses.dataclass(frozen=True)
class Slope:
    """How a measure depends on a field: measure ~ field^power."""

    power: float  # d log(measure) / d log(field)
    known_from: str  # iterations, interpolation, sensitivity or rule
    between: tuple[float, float] | None  # values of the field that it was measured between


def find_slope(context: Context, rule: Rule, value: float, iteration: Iteration) -> Slope:
    """The slope of the rule's measure at a value of its field.

    Raises:
        NotUsed: the measured effect there is zero, or opposite to that of the rule.
    """
    up = rule.direction == "up"
    known, what = context.sensitivities, (rule.field, rule.measure, value, context.axis_of(rule.measure, iteration), up)
    measured = known.slope(*what) if rule.measure in MEASURES else None
    confirmed = measured is not None and measured * rule.slope > 0 and known.is_significant(*what)
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
        weak = measured is not None and confirmed and abs(power) < WEAK * abs(measured)
        usable = not weak or known.same_interval(rule.field, value, up, there)
        if usable and power * rule.slope > 0 and abs(power) > 0.1 * abs(float(rule.slope)):
            return Slope(power, "iterations", (value, there))
    if measured is not None and confirmed:
        low, high = known.parameters[rule.field].interval(value, up)
        return Slope(measured, "sensitivity", (low.value, high.value))
    if measured is None or not context.same_trainer:
        return Slope(float(rule.slope), "rule", None)
    raise NotUsed(f"its measured effect there is {'opposite' if known.is_significant(*what) else 'zero'}")


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
    if rule.measure != "settling_time" or (bracket := _bracket(context, rule, iteration)) is None:
        return slope
    slow, fast, share = bracket
    goal = slow + share * (fast - slow)
    change = wanted / slope.power
    if slope.known_from == "iterations" and slope.between is not None:
        is_behind = math.log(slope.between[1] / value) * change < 0
        if is_behind and 0.05 < (math.log(value) + change - slow) / (fast - slow) < 0.95:
            return slope
    if abs(goal - math.log(value)) < 1e-9:
        return slope
    return Slope(wanted / (goal - math.log(value)), "interpolation", (math.exp(slow), math.exp(fast)))


def _bracket(context: Context, rule: Rule, iteration: Iteration) -> tuple[float, float, float] | None:
    """The log of the field in the nearest slower and faster iterations, and the share of the way from one to the other.

    None where one of the two does not exist. An end that stays while further iterations fall on the other side is
    weighted half as much each time. Without this, a curved relation would be followed in ever smaller edits (the
    Illinois variant of the false position method).

    Source: Dowell and Jarratt 1971, A modified regula falsi method for computing the root of an equation.
    """
    around = [
        (math.log(each.response.settling_time / context.requirement.aim()), math.log(there), each.number)
        for each, there in variants(iteration, rule.field, context.iterations)
        if math.isfinite(each.response.settling_time) and each.response.settling_time > 0
    ]
    slower, faster = [point for point in around if point[0] > 0], [point for point in around if point[0] <= 0]
    if not slower or not faster:
        return None
    (late, slow, _), (early, fast, _) = ends = min(slower), max(faster)
    stays = [sum(each[2] > end[2] for each in others) - 1 for end, others in zip(ends, (faster, slower), strict=True)]
    late, early = (off * 0.5 ** max(0, count) for off, count in zip((late, early), stays, strict=True))
    return slow, fast, max(0.1, min(0.9, late / (late - early)))
