"""The options for the next edit of an iteration: the edit of each rule, and the predicted distance after it."""

import dataclasses
import math

from flytune.config import document
from flytune.task.task import Task
from flytune.training.trainer import other_settings_fields
from flytune.tuning.iteration import Edit, Iteration, already_tried, variants
from flytune.tuning.requirement import Requirement
from flytune.tuning.rules import SHARES, Rule, apply_rule, is_fixed, number_at, symptoms
from flytune.tuning.sensitivity import FLOOR
from flytune.tuning.slopes import MEASURES, Context, NotUsed, find_slope, interpolated

TRUST = {"interpolation": 1.0, "iterations": 1.0, "sensitivity": 0.9, "rule": 0.6}  # in a slope, by its origin
EFFORT = 0.1  # cost of an edit per factor of e: of two edits with the same gain, the smaller one is better
SMALLEST = 0.002  # smallest relative change of a field
HARM = 0.5  # cost of an edit that makes another measure miss its requirement, as a share of the own miss


def find_options(context: Context, iteration: Iteration) -> tuple[list[tuple[float, Edit]], dict[str, list[str]]]:
    """The useful edits of an iteration, each with the predicted distance from the requirement; and the refusals.

    The refusals are lists of "rule (reason)" by symptom.
    """
    found: list[tuple[float, Edit]] = []
    refused: dict[str, list[str]] = {}
    for symptom in symptoms(context.requirement.misses(iteration.response)):
        for rule in context.rules:
            if rule.advice or rule.when != symptom:
                continue
            try:
                edit = _propose(context, rule, iteration)
                found.append((_predict(context, iteration, edit), edit))
            except NotUsed as reason:
                refused.setdefault(symptom, []).append(f"{rule.name} ({reason})")
    return found, refused


def _propose(context: Context, rule: Rule, iteration: Iteration) -> Edit:
    """The edit that a rule proposes.

    Raises:
        NotUsed: the rule proposes none.
    """
    value = _editable_value(context, rule, iteration)
    slope = find_slope(context, rule, value, iteration)
    if slope.known_from != "iterations" and _has_disappointed(context, rule, value):
        raise NotUsed("it was tried without success")
    now = getattr(iteration.response, rule.measure)
    up = 1 if rule.direction == "up" else -1
    expected: float | None
    if rule.measure in SHARES or not math.isfinite(now):
        after, gain, expected = apply_rule(rule, value, float(rule.largest) ** up), 0.5, None
    else:
        # never zero: a miss is outside of what is allowed, and the aim is inside
        wanted = math.log(_aim(rule.measure, context.requirement, iteration) / max(now, 1e-9))
        slope = interpolated(context, rule, iteration, value, wanted, slope)
        after = apply_rule(rule, value, math.exp(max(-3.0, min(3.0, wanted / slope.power))))
        predicted = slope.power * math.log(after / value)
        gain = min(1.0, predicted / wanted)
        expected = now * math.exp(predicted)
    if value == rule.range[up > 0]:
        raise NotUsed(f"{rule.field} is at {value:g}, the end of its range")
    if (after - value) * up <= 0 or abs(after / value - 1) < SMALLEST:
        raise NotUsed("the iterations on both sides leave nothing to change")
    if (tried := already_tried(iteration, rule.field, after, context.iterations)) is not None:
        raise NotUsed(f"{rule.field} {after:g} was tried in iteration {tried.number}")
    return Edit(
        rule=rule.name, source=rule.source, reason=rule.reason, symptom=rule.when,
        field=rule.field, before=value, after=after, unit=document.unit_of(Task, context.tables, rule.field),
        expected=expected, slope=slope.power, known_from=slope.known_from, between=slope.between, gain=gain,
        axis=context.axis_of(rule.measure, iteration),
    )  # fmt: skip


def _editable_value(context: Context, rule: Rule, iteration: Iteration) -> float:
    """The value of the rule's field in an iteration on which the rule can be used.

    Raises:
        NotUsed: it cannot be used.
    """
    value = iteration.values.get(rule.field) or number_at(context.tables, rule.field)
    misses = context.requirement.misses(iteration.response)
    if rule.field.split(".")[0] in other_settings_fields(context.trainer):
        raise NotUsed(f"{rule.field} belongs to another trainer")
    if is_fixed(rule.field, context.fixed):
        raise NotUsed(f"{rule.field} is set by the user")
    if not value or value <= 0:
        raise NotUsed(f"the task has no {rule.field}, or it is 0")
    if missed := [measure for measure in rule.requires if measure in misses and measure != rule.measure]:
        raise NotUsed(f"not while the {' and the '.join(missed).replace('_', ' ')} is missed")
    if context.same_trainer and not context.sensitivities.has_effect(
        rule.field, context.axis_of(rule.measure, iteration)
    ):
        raise NotUsed("it has no measured effect")
    return value


def _aim(measure: str, requirement: Requirement, iteration: Iteration) -> float:
    """The value of a measure that an edit aims at: the settling time itself, half of the bound of the others."""
    if measure == "settling_time":
        return requirement.aim()
    if measure == "overshoot":
        return 0.5 * max(requirement.limit("overshoot", iteration.response), 1e-3)
    return 0.5 * requirement.limit("error", iteration.response)


def _has_disappointed(context: Context, rule: Rule, value: float) -> bool:
    """Whether the last use of the rule changed its measure by less than a tenth of the prediction, or the wrong way.

    For a field with measured sensitivities only uses within the same interval count, because a field may have an
    effect only beyond a threshold.
    """
    iterations, up = context.iterations, rule.direction == "up"
    uses = (
        each
        for each in reversed(iterations)
        if each.edit
        and each.edit.rule == rule.name
        and context.sensitivities.same_interval(rule.field, value, up, each.edit.before)
    )
    last = next(uses, None)
    if last is None or last.edit is None or last.parent is None:
        return False
    before, now = (getattr(each.response, rule.measure) for each in (iterations[last.parent], last))
    if rule.measure in SHARES:
        return now <= before
    expected = last.edit.expected
    if expected is None or not math.isfinite(before):
        return not math.isfinite(now)
    return expected != before and (now - before) / (expected - before) < 0.1


def _predict(context: Context, iteration: Iteration, edit: Edit) -> float:
    """The predicted distance from the requirement after an edit.

    The miss of the edit's own measure shrinks by the gain of the edit times the trust in its slope. The other misses
    become those of the iteration that is nearest to the edit; where there is none, the measured sensitivities decide
    which other measure the edit makes miss its requirement.

    Raises:
        NotUsed: the edit is no improvement.
    """
    misses = context.requirement.weighted_misses(iteration.response)
    own, before = misses[edit.measure], sum(misses.values())
    gain = edit.gain * TRUST[edit.known_from] - EFFORT * abs(math.log(edit.after / edit.before))
    nearest = _nearest_variant(context, edit, iteration)
    if nearest is not None:
        there = context.requirement.weighted_misses(nearest.response)
        worse = {name: there[name] - misses.get(name, 0.0) for name in there if name != edit.measure}
        harm = {name: more for name, more in worse.items() if more > 0}
    else:
        others = [name for name in MEASURES if name != edit.measure and name not in misses]
        harm = {name: HARM * own for name in others if _causes_miss(context, edit, iteration, name)}
    distance = before - own * gain + sum(harm.values())
    if distance < before:
        return distance
    harmed = " and the ".join(harm).replace("_", " ")
    raise NotUsed(f"it would make the {harmed} worse" if harm else "its predicted gain is too small")


def _nearest_variant(context: Context, edit: Edit, iteration: Iteration) -> Iteration | None:
    """The iteration that differs in the edit's field alone and is nearer to the edited value than `iteration` is."""
    away = {iteration.number: abs(math.log(edit.after / edit.before))}
    for other, there in variants(iteration, edit.field, context.iterations):
        if other is not iteration:
            away[other.number] = abs(math.log(edit.after / there))
    nearest = min(away, key=away.__getitem__)
    return None if nearest == iteration.number else context.iterations[nearest]


def _causes_miss(context: Context, edit: Edit, iteration: Iteration, measure: str) -> bool:
    """Whether a measure misses its requirement after the edit, by its measured sensitivity."""
    what = (edit.field, measure, edit.before, context.axis_of(measure, iteration), edit.after > edit.before)
    slope = context.sensitivities.slope(*what)
    if slope is None or not context.sensitivities.is_significant(*what):
        return False
    now = max(getattr(iteration.response, measure), FLOOR[measure])
    then = now * math.exp(slope * math.log(edit.after / edit.before))
    return measure in context.requirement.misses(dataclasses.replace(iteration.response, **{measure: then}))
