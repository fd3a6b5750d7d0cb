"""What a tuning says: a response, an edit and its reason, what an edit did, what is missing."""

import math

from flytune.tune.requirement import MARGIN, Measured, Requirement
from flytune.tune.step import HALF_WAY, Edit, Step

NAMES = {"settling_time": "settling time"}


def describe(measured: Measured, requirement: Requirement, notes: dict[str, str] | None = None) -> str:
    """A measured response in words; `notes` says more of a measure."""
    shown = ["settling_time", "overshoot", "error", "settled", *(["kept"] if measured.kept < 1 else [])]
    said = {name: said_of(name, getattr(measured, name), requirement) for name in shown}
    settles = math.isfinite(measured.settling_time)
    words = {
        "settling_time": f"settles in {said['settling_time']}" if settles else "does not settle",
        "overshoot": f"overshoot {said['overshoot']}",
        "error": f"error {said['error']}",
        "settled": f"{said['settled']} settled",
        "kept": f"own bounds kept in {said.get('kept')}",
    }
    return ", ".join(words[name] + (notes or {}).get(name, "") for name in shown)


def describe_edit(edit: Edit, requirement: Requirement) -> str:
    """An edit in one line: what is missing, the edit, what is expected and why so, the rule, and the next best edit."""
    condition = "too far" if edit.rule == HALF_WAY else edit.condition
    known = f" ({_known(edit)})" if _known(edit) else ""
    second = ""
    if edit.second is not None:
        second = f". Next best: {edit.second.rule}, {_change(edit.second, requirement)}"
    return f"{condition}: {_change(edit, requirement)}{known}. {edit.rule}: {edit.says} ({edit.source}){second}"


def describe_step(step: Step, before: Measured | None, requirement: Requirement) -> str:
    """What a step's response is beside what it was and what was expected of its edit, and what is missing."""
    notes = {}
    if step.edit is not None and before is not None:
        measure = step.edit.measure
        note = f"was {said_of(measure, getattr(before, measure), requirement)}"
        if step.edit.expects is not None:
            note += f", expected {said_of(measure, step.edit.expects, requirement)}"
        notes[measure] = f" ({note})"
    misses = requirement.misses(step.measured, MARGIN)
    missing = ", ".join(describe_miss(name, size, requirement, MARGIN) for name, size in misses.items())
    return f"{describe(step.measured, requirement, notes)}; {f'missing: {missing}' if missing else 'met'}"


def describe_miss(measure: str, size: float, requirement: Requirement, margin: float = 1.0) -> str:
    """A miss, as `Requirement.misses` has it with this margin, in words."""
    if measure == "settling_time":
        side = "slow" if size > 0 else "fast"
        share = f"{100 * abs(math.expm1(size)):.0f} %" if math.isfinite(size) else "far"
        return f"{share} too {side} for {requirement.aim():g} s"
    if measure in ("settled", "kept"):
        share = said_of(measure, requirement.settled + size, requirement)
        return f"only {share} settle" if measure == "settled" else f"only {share} keep the bounds you have set"
    return f"{measure} above {said_of(measure, margin * getattr(requirement, measure), requirement)}"


def said_of(measure: str, value: float, requirement: Requirement) -> str:
    """A number of a measure with its unit."""
    if not math.isfinite(value):
        return "never"
    if measure == "settling_time":
        return f"{value:.2f} s"
    if measure == "error":
        return f"{math.degrees(value):.2f} deg" if requirement.axis == "yaw" else f"{1e3 * value:.1f} mm"
    return f"{100 * value:.1f} %"


def _change(edit: Edit, requirement: Requirement) -> str:
    """What is edited, and what the measure is expected to be afterwards."""
    unit = f" {edit.unit}" if edit.unit and "unit(" not in edit.unit else ""
    expects = ""
    if edit.expects is not None:
        expects = (
            f", expects {NAMES.get(edit.measure, edit.measure)} {said_of(edit.measure, edit.expects, requirement)}"
        )
    return f"{edit.field} {edit.before:g} -> {edit.after:g}{unit}{expects}"


def _known(edit: Edit) -> str:
    """Where the size of an edit comes from, with the slope it counts on."""
    if edit.rule == HALF_WAY:
        return "half of the last edit"
    if edit.known_from == "between":
        return "between the steps on both sides"
    if edit.expects is None:
        return "the rule's largest step"
    known = {"flown": "steps so far", "map": "effect map", "rule": "the rule's own guess"}[edit.known_from]
    return f"{known}: {NAMES.get(edit.measure, edit.measure)} goes as the field to the power {edit.slope:.2g}"
