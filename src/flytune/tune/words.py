"""What a tuning says: a response, an edit and its reason, what an edit did, what is missing."""

import math
from typing import Any

from flytune.tune.choose import HALF_WAY, Edit, Step
from flytune.tune.requirement import MARGIN, Requirement


def describe(measured: Any, requirement: Requirement) -> str:
    """A measured response in words."""
    time_said = f"{measured.settling_time:.2f} s" if math.isfinite(measured.settling_time) else "never"
    error = f"{math.degrees(measured.error):.2f} deg" if requirement.axis == "yaw" else f"{1e3 * measured.error:.1f} mm"
    kept = f", own bounds kept in {measured.kept:.0%}" if measured.kept < 1 else ""
    return (
        f"settles in {time_said}, overshoot {100 * measured.overshoot:.1f} %, error {error}, "
        f"{measured.settled:.1%} settled{kept}"
    )


def describe_edit(edit: Edit) -> str:
    """An edit and its reason in one line."""
    known = {"flown": "from the steps so far", "map": "from the effect map", "rule": "by the rule"}[edit.known_from]
    promise = ""
    if edit.expects is not None:
        promise = f"; expects {_value_said(edit.measure, edit.expects)}, {known}"
    condition = "too far" if edit.rule == HALF_WAY else edit.condition
    return (
        f"{condition}: {edit.field} {edit.before:g} -> {edit.after:g} ({edit.rule}: {edit.says}; "
        f"{edit.source}{promise})"
    )


def describe_step(step: Step, before: Any, requirement: Requirement) -> str:
    """What a step's response is, what is missing of it, and what its edit did."""
    parts = [describe(step.measured, requirement)]
    if step.edit is not None and before is not None:
        measure = step.edit.measure
        was, now = getattr(before, measure), getattr(step.measured, measure)
        parts.append(f"{_named(measure)} {_value_said(measure, was)} -> {_value_said(measure, now)}")
    misses = requirement.misses(step.measured, MARGIN)
    parts.append(
        f"missing: {', '.join(describe_miss(n, s, requirement) for n, s in misses.items())}" if misses else "met"
    )
    return "; ".join(parts)


def describe_miss(measure: str, size: float, requirement: Requirement) -> str:
    """A miss, as `Requirement.misses` has it, in words."""
    if measure == "settling_time":
        side = "slow" if size > 0 else "fast"
        share = f"{abs(math.expm1(size)):.0%}" if math.isfinite(size) else "far"
        return f"{share} too {side} for {requirement.aim():g} s"
    return {"settled": "trials do not settle", "kept": "bounds are broken"}.get(measure, f"{_named(measure)} too large")


def _named(measure: str) -> str:
    return {"settling_time": "settling time", "kept": "bounds kept"}.get(measure, measure)


def _value_said(measure: str, value: float) -> str:
    if not math.isfinite(value):
        return "never"
    if measure == "settling_time":
        return f"{value:.2f} s"
    return f"{1e3 * value:.1f} mm" if measure == "error" else f"{value:.1%}"
