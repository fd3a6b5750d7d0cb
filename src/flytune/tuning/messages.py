"""What a tuning says: a response, an edit and its reason, what an edit did, what is missing."""

import math

from flytune.tuning.iteration import HALF_WAY, Edit, Step
from flytune.tuning.requirement import FAR, Measured, Requirement


def describe(
    measured: Measured, requirement: Requirement, notes: dict[str, str] | None = None, *, bounds: bool = False
) -> str:
    """A measured response in words; `notes` says more of a measure, `bounds` that the user has set some."""
    settles = math.isfinite(measured.settling_time)
    said = {name: said_of(name, getattr(measured, name), requirement) for name in vars(measured)}
    words = {
        "settling_time": f"settles in {said['settling_time']}" if settles else "does not settle",
        "overshoot": f"overshoot {said['overshoot']}",
        "error": f"error {said['error']}",
        "settled": f"{said['settled']} settled",
        "kept": f"your bounds kept in {said['kept']}",
    }
    shown = [name for name in words if name != "kept" or bounds or measured.kept < 1]
    return ", ".join(words[name] + (notes or {}).get(name, "") for name in shown)


def describe_targets(requirement: Requirement, trials: int, duration: float) -> str:
    """What is asked on the tuning starts, and what that means."""
    low = (1 - requirement.tolerance) * requirement.settling_time
    time = (
        f"at most {requirement.latest():.2f} s" if requirement.at_most else f"{low:.2f} to {requirement.latest():.2f} s"
    )
    band = "3.6 deg" if requirement.axis == "yaw" else "2 cm"
    return (
        f"{time}, overshoot at most {said_of('overshoot', requirement.overshoot, requirement)}, error at most "
        f"{said_of('error', requirement.error, requirement)} in {trials} trials of {duration:g} s; settled is "
        f"within {band} to the end, a trial that does not settle counts as infinitely slow"
    )


def describe_edit(edit: Edit, requirement: Requirement) -> str:
    """An edit in one line: what is missing, the edit, what is expected and why so, the rule, and the next best edit."""
    condition = "too far" if edit.rule == HALF_WAY else edit.condition
    known = f" ({_known(edit)})" if _known(edit) else ""
    source = "" if edit.rule.startswith(f"{edit.source.removeprefix('paper ')} ") else f" ({edit.source})"
    second = ""
    if edit.second is not None and edit.second.expects is not None:
        second = f". Next best: {_change(edit.second, requirement)} ({edit.second.rule})"
    return f"{condition}: {_change(edit, requirement)}{known}. {edit.rule}: {edit.says}{source}{second}"


def describe_step(step: Step, before: Measured | None, requirement: Requirement, *, bounds: bool = False) -> str:
    """What a step's response is beside what it was and what was expected of its edit, and what is missing."""
    if step.diverged:
        return f"diverged: {step.diverged}"
    notes = {}
    if step.edit is not None and before is not None:
        measure = step.edit.measure
        note = f"was {said_of(measure, getattr(before, measure), requirement)}"
        if step.edit.expects is not None:
            note += f", expected {said_of(measure, step.edit.expects, requirement)}"
        notes[measure] = f" ({note})"
    misses = requirement.misses(step.measured)
    missing = ", ".join(describe_miss(name, size, requirement) for name, size in misses.items())
    return (
        f"{describe(step.measured, requirement, notes, bounds=bounds)}; {f'missing: {missing}' if missing else 'met'}"
    )


def describe_miss(measure: str, size: float, requirement: Requirement) -> str:
    """A miss, as `Requirement.misses` has it, in words."""
    if measure == "settling_time":
        side, for_what = ("slow" if size > 0 else "fast"), f"{requirement.settling_time:g} s"
        ratio = requirement.aim() * math.exp(size) / requirement.settling_time
        share = f"{100 * abs(ratio - 1):.0f} %" if abs(size) < FAR else "far"
        return f"{share} too {side} for {'at most ' if requirement.at_most else ''}{for_what}"
    if measure in ("settled", "kept"):
        share = said_of(measure, requirement.settled + size, requirement)
        return f"only {share} settle" if measure == "settled" else f"only {share} keep the bounds you have set"
    return f"{measure} above {said_of(measure, getattr(requirement, measure), requirement)}"


def said_of(measure: str, value: float, requirement: Requirement) -> str:
    """A number of a measure with its unit."""
    if not math.isfinite(value):
        return "never" if measure == "settling_time" else "infinite"
    if measure == "settling_time":
        return f"{value:.2f} s"
    if measure == "error":
        return f"{math.degrees(value):.2f} deg" if requirement.axis == "yaw" else f"{1e3 * value:.2f} mm"
    return f"{100 * value:.1f} %"


def _named(measure: str) -> str:
    return measure.replace("_", " ")


def _change(edit: Edit, requirement: Requirement) -> str:
    """What is edited, and what the measure is expected to be afterwards."""
    unit = f" {edit.unit}" if edit.unit and "unit(" not in edit.unit else ""
    expects = ""
    if edit.expects is not None:
        expects = f", expects {_named(edit.measure)} {said_of(edit.measure, edit.expects, requirement)}"
    return f"{edit.field} {edit.before:g} -> {edit.after:g}{unit}{expects}"


def _known(edit: Edit) -> str:
    """Where the size of an edit comes from: the power law it counts on, and what that was measured between."""
    if edit.rule == HALF_WAY:
        return f"half-way back to {edit.before:g}, in logarithms"
    if edit.expects is None:
        return "no number can be promised: the rule's largest step"
    law = f"{_named(edit.measure)} ~ {edit.field.split('.')[-1]}^{edit.slope:.2g}"
    if edit.ends is None:
        return f"{law}, the rule's own guess, not measured"
    low, high = sorted(edit.ends)
    inside = low <= min(edit.before, edit.after) and max(edit.before, edit.after) <= high
    where = {
        "flown": f"{law} in the steps at {low:g} and {high:g}",
        "map": f"{law} between {low:g} and {high:g} of the effect map{'' if inside else ', extrapolated'}",
        "between": f"false position between the steps at {low:.3g} and {high:.3g}, one too slow and one too fast",
    }
    return where[edit.known_from]
