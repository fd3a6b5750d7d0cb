"""Which edit to make next: of all rules that fit what is missing, the one that promises most."""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Any

from flytune.tune.effects import Effects
from flytune.tune.requirement import MARGIN, Measured, Requirement
from flytune.tune.rules import CONDITIONS, Rule, conditions, field_of, moved

# what is cured first where several things are missing
URGENCY = {"unsettled": 1.3, "breaks a bound": 1.1, "too slow": 1.0, "too fast": 1.0, "overshoots": 0.8, "inexact": 0.8}
TRUST = {"flown": 1.0, "map": 0.9, "rule": 0.6}  # in a slope, by where it comes from
EFFORT = 0.1  # what a factor of e costs: of two edits that promise the same, the smaller
HALF_WAY = "back half-way"


@dataclasses.dataclass(frozen=True, kw_only=True)
class Edit:
    """One change of one field, and what it is for."""

    rule: str
    source: str
    says: str
    condition: str
    field: str
    before: float
    after: float
    expects: float | None  # of the rule's measure; None where no number can be promised
    known_from: str  # flown, map or rule

    @property
    def measure(self) -> str:
        """What it is to change."""
        return CONDITIONS[self.condition][0]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Step:
    """One policy of the loop: the edits it was trained with, and how it flies."""

    number: int
    values: Mapping[str, float]  # field -> value, of every edit so far
    reasons: Mapping[str, str]  # field -> why
    edit: Edit | None  # the last of them; None for the policy the loop began with
    origin: int | None  # the number of the step that was edited
    measured: Measured
    seconds: float  # of training

    def to_dict(self) -> dict[str, Any]:
        """Plain values."""
        return dataclasses.asdict(self) | {"measured": self.measured.to_dict()}

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> "Step":
        """The inverse of `to_dict`."""
        edit = Edit(**data["edit"]) if data["edit"] else None
        return cls(**{**data, "edit": edit, "measured": Measured.from_dict(data["measured"])})


@dataclasses.dataclass(frozen=True)
class _Case:
    """All that a choice rests on; what each is, `choose` says."""

    steps: Sequence[Step]
    tables: Mapping[str, Any]
    requirement: Requirement
    rules: Sequence[Rule]
    effects: Effects
    fixed: Sequence[str]
    margin: float


def choose(
    steps: Sequence[Step],
    tables: Mapping[str, Any],
    requirement: Requirement,
    rules: Sequence[Rule],
    effects: Effects,
    fixed: Sequence[str],
    margin: float = MARGIN,
) -> tuple[Step, Edit] | list[str]:
    """The step to go on from and its edit; where no rule can help, why not, one line for each that was looked at.

    Args:
        steps: all so far, the first one the start.
        tables: the task of the start, as nested tables.
        requirement: what is wanted.
        rules: those that may be used.
        effects: what each knob was measured to do.
        fixed: field paths the user has set; they, and what lies under them, are not touched.
        margin: the share of the tolerance that counts as met.
    """
    case = _Case(steps, tables, requirement, rules, effects, fixed, margin)
    last = steps[-1]
    if (edit := _half_way(steps, requirement)) is not None:
        return steps[last.origin or 0], edit
    ranked = sorted(steps, key=lambda step: (_distance(step, requirement, margin), -step.number))
    refused: list[str] = []
    for origin in dict.fromkeys(step.number for step in (ranked[0], last)):
        step = steps[origin]
        found = _best_edit(case, step, refused)
        if found is not None:
            return step, found
    return refused


def _best_edit(case: _Case, step: Step, refused: list[str]) -> Edit | None:
    misses = case.requirement.misses(step.measured, case.margin)
    options: list[tuple[float, Edit]] = []
    for condition in conditions(misses):
        for rule in case.rules:
            if rule.advice or rule.when != condition:
                continue
            edit, gain = _edit(case, rule, step, misses)
            if isinstance(edit, str):
                refused.append(f"{condition}: {rule.name}: {edit}")
            else:
                options.append((URGENCY[condition] * gain, edit))
    return max(options, key=lambda option: option[0])[1] if options else None


def _edit(case: _Case, rule: Rule, step: Step, misses: Mapping[str, float]) -> tuple[Edit | str, float]:
    """The edit a rule asks for and its gain, the share of what is missing that it promises; or why it is not used."""
    if any(rule.field == path or rule.field.startswith(f"{path}.") for path in case.fixed):
        return f"{rule.field} is set by the user", 0.0
    value = step.values.get(rule.field) or field_of(dict(case.tables), rule.field)
    if not value or value <= 0:
        return f"the task has no {rule.field}, or it is 0", 0.0
    if missed := [measure for measure in rule.spares if measure in misses and measure != rule.measure]:
        return f"forbidden while {', '.join(missed)} is missed", 0.0
    if _disappointed(rule, case.steps):
        return "it was tried, and did not help", 0.0
    slope, known_from = _slope(rule, value, step, case.steps, case.effects)
    if slope is None:
        return known_from, 0.0
    aim = math.nan if rule.measure in ("settled", "kept") else _aim(rule.measure, case.requirement, case.margin)
    now = getattr(step.measured, rule.measure)
    up = 1 if rule.direction == "up" else -1
    expects: float | None
    if rule.measure in ("settled", "kept") or not math.isfinite(now):
        after, gain, expects = moved(rule, value, float(rule.largest) ** up), 0.5, None
    else:
        wanted = math.log(aim / max(now, 1e-9))
        factor = math.exp(max(-3.0, min(3.0, wanted / slope)))
        bracketed = _between(rule, step, case.steps, aim) if rule.measure == "settling_time" else None
        after = moved(rule, value, bracketed / value if bracketed else factor)
        promised = slope * math.log(after / value)
        gain = min(1.0, promised / wanted) if wanted else 0.0
        expects = now * math.exp(promised)
    if (after - value) * up <= 0 or abs(after / value - 1) < 0.002:
        return f"{rule.field} is at {value:g}, the end of its range", 0.0
    edit = Edit(
        rule=rule.name,
        source=rule.source,
        says=rule.says,
        condition=rule.when,
        field=rule.field,
        before=value,
        after=after,
        expects=expects,
        known_from=known_from,
    )
    cost = EFFORT * abs(math.log(after / value)) + _harm(case, edit, step, rule.measure, misses)
    return edit, gain * TRUST[known_from] - cost


def _aim(measure: str, requirement: Requirement, margin: float) -> float:
    """Where to steer a measure to: the settling time itself, half of what is allowed for the others."""
    if measure == "settling_time":
        return requirement.aim()
    return 0.5 * margin * max(getattr(requirement, measure), 1e-3)


def _alike(first: Step, second: Step, field: str) -> bool:
    """Whether two steps differ in this field alone."""
    names = (set(first.values) | set(second.values)) - {field}
    return all(first.values.get(name) == second.values.get(name) for name in names)


def _value(step: Step, field: str, steps: Sequence[Step]) -> float | None:
    """The field's value in a step; before its first edit, what that edit found."""
    if field in step.values:
        return step.values[field]
    return next((each.edit.before for each in steps if each.edit and each.edit.field == field), None)


def _slope(rule: Rule, value: float, step: Step, steps: Sequence[Step], effects: Effects) -> tuple[float | None, str]:
    """d log(measure) / d log(field) and where it is known from; None and the reason where the rule does not hold."""
    flown = []
    for other in steps:
        there = _value(other, rule.field, steps)
        if other is step or there is None or not _alike(step, other, rule.field) or abs(math.log(there / value)) < 0.02:
            continue
        now, then = (getattr(each.measured, rule.measure) for each in (step, other))
        if now > 0 and then > 0 and math.isfinite(now) and math.isfinite(then):
            flown.append((abs(math.log(there / value)), math.log(then / now) / math.log(there / value)))
    if flown:
        found = min(flown)[1]
        if found * rule.slope > 0 and abs(found) > 0.1 * abs(float(rule.slope)):
            return found, "flown"
    measured = effects.elasticity(rule.field, rule.measure, value) if rule.measure in MEASURES else None
    if measured is None:
        return float(rule.slope), "rule"
    if not effects.matters(rule.field, rule.measure, value):
        return None, "measured to have no effect there"
    if measured * float(rule.slope) <= 0:
        return None, "measured to have the opposite effect there"
    return measured, "map"


MEASURES = ("settling_time", "overshoot", "error")  # that the effect map knows


def _between(rule: Rule, step: Step, steps: Sequence[Step], aim: float) -> float | None:
    """The field's value between the nearest faster and slower steps, on a line in logarithms; None without both."""
    around = [
        (math.log(there), math.log(each.measured.settling_time / aim))
        for each in steps
        if _alike(step, each, rule.field)
        and (there := _value(each, rule.field, steps)) is not None
        and math.isfinite(each.measured.settling_time)
        and each.measured.settling_time > 0
    ]
    slow = min((point for point in around if point[1] > 0), key=lambda point: point[1], default=None)
    fast = max((point for point in around if point[1] <= 0), key=lambda point: point[1], default=None)
    if slow is None or fast is None:
        return None
    share = slow[1] / (slow[1] - fast[1])
    return math.exp(slow[0] + max(0.1, min(0.9, share)) * (fast[0] - slow[0]))


def _disappointed(rule: Rule, steps: Sequence[Step]) -> bool:
    """Whether the rule's last use moved its measure by less than a tenth of what it promised, or the wrong way."""
    used = [step for step in steps if step.edit and step.edit.rule == rule.name and step.origin is not None]
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


def _harm(case: _Case, edit: Edit, step: Step, own: str, misses: Mapping[str, float]) -> float:
    """What the edit is measured to cost in the other measures: a half for each it pushes over its bound."""
    cost = 0.0
    for measure in MEASURES:
        if measure == own or measure in misses:
            continue
        slope = case.effects.elasticity(edit.field, measure, edit.before)
        if slope is None or not case.effects.matters(edit.field, measure, edit.before):
            continue
        now = max(getattr(step.measured, measure), 0.002 if measure == "overshoot" else 1e-6)
        then = dataclasses.replace(
            step.measured, **{measure: now * math.exp(slope * math.log(edit.after / edit.before))}
        )
        cost += 0.5 * (measure in case.requirement.misses(then))
    return cost


def _half_way(steps: Sequence[Step], requirement: Requirement) -> Edit | None:
    """Where the last edit lost trials that had settled: half of it, from where it was made."""
    last = steps[-1]
    if last.edit is None or last.origin is None:
        return None
    origin = steps[last.origin]
    lost = requirement.misses(last.measured).get("settled", 0.0)
    if lost > -0.05 or requirement.misses(origin.measured).get("settled", 0.0) < lost / 2:
        return None
    before, after = last.edit.before, last.edit.after
    middle = float(f"{math.sqrt(before * after):.3g}")
    if abs(math.log(middle / before)) < 0.03:
        return None
    return dataclasses.replace(
        last.edit, rule=HALF_WAY, source="flytune", after=middle, expects=None,
        says=f"after {last.edit.rule} only {last.measured.settled:.0%} of the trials settled",
    )  # fmt: skip


def _distance(step: Step, requirement: Requirement, margin: float) -> float:
    narrowed = dataclasses.replace(
        requirement, overshoot=margin * requirement.overshoot, error=margin * requirement.error
    )
    return narrowed.distance(step.measured)
