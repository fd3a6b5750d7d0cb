"""Which edit to make next: of all rules that fit what is missing, the one that promises most."""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Any

from flytune.config import document
from flytune.errors import BadInput
from flytune.task.task import Task
from flytune.training.trainer import DEFAULT_TRAINER, other_settings_fields
from flytune.tuning.iteration import HALF_WAY, Edit, Step
from flytune.tuning.requirement import Requirement
from flytune.tuning.rules import Rule, conditions, field_of, is_fixed, is_whole, moved
from flytune.tuning.sensitivity import FLOOR, Effects

TRUST = {"between": 1.0, "flown": 1.0, "map": 0.9, "rule": 0.6}  # in a slope, by where it comes from
EFFORT = 0.1  # what a factor of e costs: of two edits that promise the same, the smaller
SMALLEST = 0.002  # share of its value that an edit changes a field by, at least
SAME = 0.01  # two values of a field nearer than this share are the same
FEEBLE = 0.25  # a slope less than this share of the effect map's, flown elsewhere, does not count
HARM = 0.5  # what it costs to push another measure over its bound
MEASURES = ("settling_time", "overshoot", "error")  # that the effect map knows


@dataclasses.dataclass(frozen=True)
class _Case:
    """All that a choice rests on; what each is, `choose` says."""

    steps: Sequence[Step]
    tables: Mapping[str, Any]
    requirement: Requirement
    rules: Sequence[Rule]
    effects: Effects
    fixed: Sequence[str]
    trainer: str

    @property
    def mapped(self) -> bool:
        """Whether the effect map is of this trainer, so that an effect it did not find is not there."""
        return self.trainer == self.effects.facts["trainer"]


def choose(
    steps: Sequence[Step],
    tables: Mapping[str, Any],
    requirement: Requirement,
    rules: Sequence[Rule],
    effects: Effects,
    fixed: Sequence[str],
    trainer: str = DEFAULT_TRAINER,
) -> tuple[Step, Edit] | list[str]:
    """The step to go on from and its edit; where no rule can help, why not, one line for each that was looked at.

    Args:
        steps: all so far, the first one the start.
        tables: the task of the start, as nested tables.
        requirement: what is wanted of the starts the steps were measured on.
        rules: those that may be used.
        effects: what each parameter was measured to do.
        fixed: field paths the user has set; they, and what lies under them, are not touched.
        trainer: apg or ppo; rules for settings of the other are left out.
    """
    case = _Case(steps, tables, requirement, rules, effects, fixed, trainer)
    if (edit := _half_way(case)) is not None:
        return steps[steps[-1].origin or 0], edit
    nearest = min(steps, key=lambda step: (_left(case, step), -step.number))
    options: list[tuple[float, int, Edit]] = []
    refused: dict[str, list[str]] = {}
    for step in (step for step in steps if not step.diverged):
        found, why_not = _options(case, step)
        options += [(left, -step.number, edit) for left, edit in found]
        refused = why_not if step is nearest else refused
    if not options:
        return [f"{condition}: {', '.join(reasons)}" for condition, reasons in refused.items()]
    options.sort(key=lambda option: option[:2])
    allowed = (option for option in options if _allowed(case, steps[-option[1]], option[2]))
    chosen = next(allowed, None)
    if chosen is None:
        edits = {f"{edit.rule} ({edit.field} {edit.after:g} is not allowed in this task)" for _, _, edit in options}
        return sorted(edits)
    _, number, best = chosen
    second = next((edit for _, other, edit in allowed if other == number and edit.field != best.field), None)
    return steps[-number], dataclasses.replace(best, second=second)


def _allowed(case: _Case, step: Step, edit: Edit) -> bool:
    """Whether the task can have the edit: a field may be bound by another, as `narrow` is by `wide`."""
    tables = dict(case.tables)
    for path, value in {**step.values, edit.field: edit.after}.items():
        tables = document.edit(tables, path, round(value) if is_whole(tables, path) else value)
    try:
        document.read(Task, tables)
    except BadInput:
        return False
    return True


def _left(case: _Case, step: Step) -> float:
    """How far a step is from what is wanted."""
    return sum(case.requirement.parts(step.measured).values())


def _options(case: _Case, step: Step) -> tuple[list[tuple[float, Edit]], dict[str, list[str]]]:
    """The edits of a step that promise more than they cost, each with how far it is expected to be then; and by
    condition, why not the others."""
    found: list[tuple[float, Edit]] = []
    refused: dict[str, list[str]] = {}
    for condition in conditions(case.requirement.misses(step.measured)):
        for rule in case.rules:
            if rule.advice or rule.when != condition:
                continue
            edit = _edit(case, rule, step)
            left, why_not = (0.0, edit) if isinstance(edit, str) else _left_after(case, step, edit)
            if why_not:
                refused.setdefault(condition, []).append(f"{rule.name} ({why_not})")
            elif isinstance(edit, Edit):
                found.append((left, edit))
    return found, refused


def _left_after(case: _Case, step: Step, edit: Edit) -> tuple[float, str]:
    """How far the edited step is expected to be, and why that is no gain, where it is none.

    What is missing of the edit's own measure shrinks by the share that the edit promises, as far as that can be
    trusted; of the other measures it becomes what it is in the step flown nearest to where the edit goes, or, where
    there is none, what the effect map warns of.
    """
    parts = case.requirement.parts(step.measured)
    own, before = parts[edit.measure], sum(parts.values())
    gain = edit.gain * TRUST[edit.known_from] - EFFORT * abs(math.log(edit.after / edit.before))
    nearby = _nearby(case, edit, step)
    if nearby is not None:
        there = case.requirement.parts(nearby.measured)
        worse = {name: there[name] - parts.get(name, 0.0) for name in there if name != edit.measure}
        harm = {name: more for name, more in worse.items() if more > 0}
    else:
        others = [name for name in MEASURES if name != edit.measure and name not in parts]
        harm = {name: HARM * own for name in others if _mapped_miss(case, edit, step, name)}
    left = before - own * gain + sum(harm.values())
    if left < before:
        return left, ""
    harmed = " and the ".join(harm).replace("_", " ")
    return left, f"would harm the {harmed} more" if harm else "promises too little"


def _edit(case: _Case, rule: Rule, step: Step) -> Edit | str:
    """The edit a rule asks for, or why the rule is not used."""
    misses = case.requirement.misses(step.measured)
    axis = case.requirement.axis
    if rule.field.split(".")[0] in other_settings_fields(case.trainer):
        return f"{rule.field} is of another trainer"
    if is_fixed(rule.field, case.fixed):
        return f"{rule.field} is set by the user"
    value = step.values.get(rule.field) or field_of(dict(case.tables), rule.field)
    if not value or value <= 0:
        return f"the task has no {rule.field}, or it is 0"
    if missed := [measure for measure in rule.spares if measure in misses and measure != rule.measure]:
        return f"not while the {' and the '.join(missed).replace('_', ' ')} is missed"
    if case.mapped and not case.effects.moves(rule.field, axis):
        return "measured to move nothing"
    slope = _slope(case, rule, value, step)
    if isinstance(slope, str):
        return slope
    if slope.known_from != "flown" and _disappointed(case, rule, value):
        return "it was tried, and did not help"
    now = getattr(step.measured, rule.measure)
    up = 1 if rule.direction == "up" else -1
    expects: float | None
    if rule.measure in ("settled", "kept") or not math.isfinite(now):
        after, gain, expects = moved(rule, value, float(rule.largest) ** up), 0.5, None
    else:
        # a miss is never nothing: the aim lies within what is allowed
        wanted = math.log(_aim(rule.measure, case.requirement) / max(now, 1e-9))
        slope = _interpolated(case, rule, step, value, wanted, slope)
        after = moved(rule, value, math.exp(max(-3.0, min(3.0, wanted / slope.power))))
        promised = slope.power * math.log(after / value)
        gain = min(1.0, promised / wanted)
        expects = now * math.exp(promised)
    if value == rule.range[up > 0]:
        return f"{rule.field} is at {value:g}, the end of its range"
    if (after - value) * up <= 0 or abs(after / value - 1) < SMALLEST:
        return "the steps on both sides leave nothing to change"
    if (twin := _twin(case, step, rule.field, after)) is not None:
        return f"{rule.field} {after:g} was flown in step {twin.number}"
    return Edit(
        rule=rule.name,
        source=rule.source,
        says=rule.says,
        condition=rule.when,
        field=rule.field,
        before=value,
        after=after,
        unit=document.unit_of(Task, case.tables, rule.field),
        expects=expects,
        slope=slope.power,
        known_from=slope.known_from,
        ends=slope.ends,
        gain=gain,
    )


def _aim(measure: str, requirement: Requirement) -> float:
    """Where to steer a measure to: the settling time itself, half of what is allowed for the others."""
    if measure == "settling_time":
        return requirement.aim()
    return 0.5 * (max(requirement.overshoot, 1e-3) if measure == "overshoot" else requirement.error)


def _alike(first: Step, second: Step, field: str) -> bool:
    """Whether two steps differ in this field alone."""
    names = (set(first.values) | set(second.values)) - {field}
    return all(first.values.get(name) == second.values.get(name) for name in names)


def _twin(case: _Case, step: Step, field: str, value: float) -> Step | None:
    """A step that had this value of the field, and all else as this step has it."""
    for other in case.steps:
        there = _value(other, field, case.steps)
        if there is not None and _alike(step, other, field) and abs(math.log(there / value)) < SAME:
            return other
    return None


def _value(step: Step, field: str, steps: Sequence[Step]) -> float | None:
    """The field's value in a step; before its first edit, what that edit found."""
    if field in step.values:
        return step.values[field]
    return next((each.edit.before for each in steps if each.edit and each.edit.field == field), None)


@dataclasses.dataclass(frozen=True)
class _Slope:
    """How a measure goes with a field: as its value to this power."""

    power: float  # d log(measure) / d log(field)
    known_from: str
    ends: tuple[float, float] | None  # values of the field it was measured between


def _slope(case: _Case, rule: Rule, value: float, step: Step) -> _Slope | str:
    """How the rule's measure goes with its field there; or why the rule does not hold there."""
    up = rule.direction == "up"
    what = (rule.field, rule.measure, value, case.requirement.axis, up)
    mapped = case.effects.elasticity(*what) if rule.measure in MEASURES else None
    holds = mapped is not None and mapped * rule.slope > 0 and case.effects.matters(*what)
    flown = []
    for other in case.steps:
        there = _value(other, rule.field, case.steps)
        if other is step or there is None or not _alike(step, other, rule.field) or abs(math.log(there / value)) < SAME:
            continue
        now, then = (getattr(each.measured, rule.measure) for each in (step, other))
        if now > 0 and then > 0 and math.isfinite(now) and math.isfinite(then):
            flown.append((abs(math.log(there / value)), math.log(then / now) / math.log(there / value), there))
    if flown:
        _, power, there = min(flown)
        # where the map knows of a threshold ahead, what was flown before it says nothing of what comes after
        feeble = holds and mapped is not None and abs(power) < FEEBLE * abs(mapped)
        told = not feeble or case.effects.ahead(rule.field, value, up, there)
        if told and power * rule.slope > 0 and abs(power) > 0.1 * abs(float(rule.slope)):
            return _Slope(power, "flown", (value, there))
    if holds and mapped is not None:
        low, high = case.effects.parameters[rule.field].around(value, up)
        return _Slope(mapped, "map", (low.value, high.value))
    if mapped is None or not case.mapped:
        return _Slope(float(rule.slope), "rule", None)
    nothing = not case.effects.matters(*what)
    return f"measured to have {'no effect' if nothing else 'the opposite effect'} there"


def _interpolated(case: _Case, rule: Rule, step: Step, value: float, wanted: float, slope: _Slope) -> _Slope:
    """The slope of the way to a value between a faster and a slower step, where there are both.

    The slope from a step that lies behind stays, if it leads between them.
    """
    ends = _ends(rule, step, case.steps, case.requirement.aim()) if rule.measure == "settling_time" else None
    if ends is None:
        return slope
    slow, fast, share = ends
    goal = slow + share * (fast - slow)
    way = wanted / slope.power
    inside = 0.05 < (math.log(value) + way - slow) / (fast - slow) < 0.95
    behind = slope.known_from == "flown" and slope.ends is not None and math.log(slope.ends[1] / value) * way < 0
    if (behind and inside) or abs(goal - math.log(value)) < 1e-9:
        return slope
    return _Slope(wanted / (goal - math.log(value)), "between", (math.exp(slow), math.exp(fast)))


def _ends(rule: Rule, step: Step, steps: Sequence[Step], aim: float) -> tuple[float, float, float] | None:
    """The logarithms of the field in the nearest slower and faster steps, and how far to go from the one to the other;
    None without both.

    Where one end stays while step after step falls on the other side, it counts half as much each time: a curve that
    bends would else be followed in ever smaller steps (the Illinois variant of the false position method).

    Source: Dowell and Jarratt 1971, A modified regula falsi method for computing the root of an equation.
    """
    around = [
        (math.log(each.measured.settling_time / aim), math.log(there), each.number)
        for each in steps
        if _alike(step, each, rule.field)
        and (there := _value(each, rule.field, steps)) is not None
        and math.isfinite(each.measured.settling_time)
        and each.measured.settling_time > 0
    ]
    slower, faster = [p for p in around if p[0] > 0], [p for p in around if p[0] <= 0]
    if not slower or not faster:
        return None
    (late, slow, _), (early, fast, _) = ends = min(slower), max(faster)
    stays = [sum(each[2] > end[2] for each in others) - 1 for end, others in zip(ends, (faster, slower), strict=True)]
    late, early = (off * 0.5 ** max(0, count) for off, count in zip((late, early), stays, strict=True))
    return slow, fast, max(0.1, min(0.9, late / (late - early)))


def _disappointed(case: _Case, rule: Rule, value: float) -> bool:
    """Whether the rule's last use moved its measure by less than a tenth of what it promised, or the wrong way.

    Of a field that the effect map knows, only uses between the same two of its values count: a parameter may have an effect
    only beyond a threshold.
    """
    steps, up = case.steps, rule.direction == "up"
    used = [
        step
        for step in steps
        if step.edit
        and step.edit.rule == rule.name
        and step.origin is not None
        and case.effects.ahead(rule.field, value, up, step.edit.before)
    ]
    if not used:
        return False
    after = used[-1]
    before = getattr(steps[after.origin or 0].measured, rule.measure)
    now = getattr(after.measured, rule.measure)
    if rule.measure in ("settled", "kept"):
        return now <= before
    assert after.edit is not None
    expects = after.edit.expects
    if expects is None or not math.isfinite(before):
        return not math.isfinite(now)
    return (now - before) / (expects - before) < 0.1 if expects != before else False


def _nearby(case: _Case, edit: Edit, step: Step) -> Step | None:
    """The step that differs in the edit's field alone and is nearest to the edit's value, nearer than its origin is."""
    away = {step.number: abs(math.log(edit.after / edit.before))}
    for other in case.steps:
        there = _value(other, edit.field, case.steps)
        if other is not step and there is not None and _alike(step, other, edit.field):
            away[other.number] = abs(math.log(edit.after / there))
    nearest = min(away, key=away.__getitem__)
    return None if nearest == step.number else case.steps[nearest]


def _mapped_miss(case: _Case, edit: Edit, step: Step, measure: str) -> bool:
    """Whether a measure misses its bound after the edit, by the slope of the effect map."""
    what = (edit.field, measure, edit.before, case.requirement.axis, edit.after > edit.before)
    slope = case.effects.elasticity(*what)
    if slope is None or not case.effects.matters(*what):
        return False
    now = max(getattr(step.measured, measure), FLOOR[measure])
    then = now * math.exp(slope * math.log(edit.after / edit.before))
    return measure in case.requirement.misses(dataclasses.replace(step.measured, **{measure: then}))


def _half_way(case: _Case) -> Edit | None:
    """Where the last edit lost trials that had settled: half of it, from where it was made."""
    last = case.steps[-1]
    if last.edit is None or last.origin is None or last.edit.rule == HALF_WAY or last.edit.measure == "settled":
        return None
    origin = case.steps[last.origin]
    lost = case.requirement.misses(last.measured).get("settled", 0.0)
    if lost > -0.05 or case.requirement.misses(origin.measured).get("settled", 0.0) < lost / 2:
        return None
    before, after = last.edit.before, last.edit.after
    middle = float(f"{math.sqrt(before * after):.3g}")
    if abs(math.log(middle / before)) < 0.03 or _twin(case, origin, last.edit.field, middle) is not None:
        return None
    return dataclasses.replace(
        last.edit, rule=HALF_WAY, source="flytune", after=middle, expects=None, second=None,
        says=f"after {last.edit.rule} only {last.measured.settled:.0%} of the trials settled",
    )  # fmt: skip
