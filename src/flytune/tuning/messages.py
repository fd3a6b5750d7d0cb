"""Messages of a tuning: a response, an edit and its reason, the result of an edit, and what misses the requirement."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

from flytune.evaluation.metrics import POSITION_BAND, YAW_BAND
from flytune.tuning.iteration import HALF_WAY, Edit, Iteration
from flytune.tuning.requirement import LARGEST_MISS, Requirement, ResponseSummary
from flytune.tuning.rules import SHARES


def line(topic: str, text: str) -> str:
    """One line of the log: the topic in a column of its own."""
    return f"{topic:<14}{text}"


def describe(
    response: ResponseSummary, requirement: Requirement, notes: Mapping[str, str] | None = None, *, bounds: bool = False
) -> str:
    """A response in one line.

    Args:
        response: the response.
        requirement: the requirement, for the axes.
        notes: measure -> a note in brackets.
        bounds: whether the user has set constraints, which are then always mentioned.
    """
    notes = notes or {}

    def told(measure: str) -> str:
        """The number of each axis that is asked for; the note stands behind the one that counts."""
        if measure in SHARES:
            return with_unit(measure, getattr(response, measure))
        leading = requirement.axis_of(measure, response)
        values = response.each.get(measure) or {leading: getattr(response, measure)}
        return ", ".join(
            with_unit(measure, value, axis)
            + f" ({axis})" * bool(requirement.others)
            + notes.get(measure, "") * (axis == leading)
            for axis, value in values.items()
        )

    times = response.each.get("settling_time", {"": response.settling_time})
    settles = any(math.isfinite(value) for value in times.values())
    never = f"does not settle{notes.get('settling_time', '')}"
    texts = {
        "settling_time": f"settles in {told('settling_time')}" if settles else never,
        "overshoot": f"overshoot {told('overshoot')}",
        "error": f"error {told('error')}",
        "settled": f"{told('settled')} settled",
        "constraints_satisfied": f"your constraints are satisfied in {told('constraints_satisfied')}",
    }
    shown = [name for name in texts if name != "constraints_satisfied" or bounds or response.constraints_satisfied < 1]
    return ", ".join(texts[name] + (notes.get(name, "") if name in SHARES else "") for name in shown)


def describe_target(target: Requirement, trials: int, duration: float) -> str:
    """The requirement on the training set, and when a trial counts as settled."""
    lowest, highest = (1 - target.tolerance) * target.settling_time, target.maximum_settling_time()
    time = f"at most {highest:.2f} s" if target.at_most else f"{lowest:.2f} to {highest:.2f} s"
    asked = (target, *target.others)
    bounds = (
        f"{f'{each.axis}: ' if target.others else ''}overshoot at most {with_unit('overshoot', each.overshoot)}, "
        f"error at most {with_unit('error', each.error, each.axis)}"
        for each in asked
    )
    units = {each.axis == "yaw" for each in asked}
    band = " and ".join(
        [f"{100 * POSITION_BAND:g} cm"] * (False in units) + [f"{math.degrees(YAW_BAND):g} deg"] * (True in units)
    )
    return (
        f"{trials} trials of {duration:g} s; required there: {time}, {'; '.join(bounds)}. "
        f"A trial has settled if it stays within {band} until its end; a trial that has not counts as infinitely slow"
    )


def describe_fixed(edits: Mapping[str, Any], requirement: Requirement, constraints: Sequence[str]) -> str:
    """The fields that the user has set, and the constraints among them."""
    fields = ", ".join(f"{path} = {value}" for path, value in edits.items())
    share = f"{100 * requirement.settled:g} % of the trials"
    return f"by you: {fields}" + (f"; required in {share}: {', '.join(constraints)}" if constraints else "")


def describe_start(name: str, times: Mapping[str, float], setting: Mapping[str, float], duration: float) -> str:
    """The settling times of the known policies, and the one that the tuning starts with, with its dial's setting."""
    if setting:
        words = ", ".join(f"{dial} at {value:g}" for dial, value in setting.items())
        return f"the policy with a dial, {words}, settles in {times[name]:.2f} s; no training was needed for it"
    never = f"does not settle within {duration:g} s"
    known = ", ".join(f"{task} {f'{time:.2f} s' if math.isfinite(time) else never}" for task, time in times.items())
    nearest = f"; the tuning starts with {name}, which is nearest as a ratio" if len(times) > 1 else ""
    return f"settling times of the known policies: {known}{nearest}"


def describe_first_training(name: str, trained_for: str, warm: bool) -> str:
    """Why a tuning begins with a training without an edit, and from which weights.

    Args:
        name: of the task it begins with.
        trained_for: the field in which the task of the known policy differs, empty where no policy is known.
        warm: whether the training starts from the weights of that policy.
    """
    known = "no policy for this task is known"
    if trained_for:
        known = f"its policy was trained with another {trained_for}"
    weights = "the weights of this policy" if warm else "new weights"
    return f"{name}: {known}; the task is trained without an edit first, from {weights}"


def describe_edit(edit: Edit) -> str:
    """An edit in one line: the symptom, the edit, the prediction and its origin, the rule, and the next best edit."""
    symptom = "the last edit was too large" if edit.rule == HALF_WAY else edit.symptom
    origin = f" ({_origin(edit)})" if _origin(edit) else ""
    source = "" if edit.rule.startswith(f"{edit.source.removeprefix('paper ')} ") else f" ({edit.source})"
    next_best = ""
    if edit.next_best is not None and edit.next_best.expected is not None:
        next_best = f". Next best: {_change(edit.next_best)} ({edit.next_best.rule})"
    return f"{symptom}: {_change(edit)}{origin}. {edit.rule}: {edit.reason}{source}{next_best}"


def describe_iteration(
    iteration: Iteration, before: ResponseSummary | None, requirement: Requirement, *, bounds: bool = False
) -> str:
    """The response of an iteration beside the one before and the expected one, and what misses the requirement.

    Args:
        iteration: the iteration.
        before: the response of its parent, None without one.
        requirement: the requirement on the training set.
        bounds: whether the user has set constraints.
    """
    if iteration.diverged:
        return f"diverged: {iteration.diverged}"
    notes = {}
    if iteration.edit is not None and before is not None:
        measure = iteration.edit.measure
        note = f"was {with_unit(measure, getattr(before, measure), requirement.axis_of(measure, before))}"
        if iteration.edit.expected is not None:
            note += f", expected {with_unit(measure, iteration.edit.expected, iteration.edit.axis)}"
        notes[measure] = f" ({note})"
    return (
        f"{describe(iteration.response, requirement, notes, bounds=bounds)}; "
        f"{describe_misses(requirement.misses(iteration.response), requirement, iteration.response.axes)}"
    )


def describe_misses(
    misses: Mapping[str, float], requirement: Requirement, axes: Mapping[str, str] | None = None
) -> str:
    """All misses in words, or that the requirement is met; `axes` are those of the response."""
    texts = [describe_miss(name, size, requirement, (axes or {}).get(name)) for name, size in misses.items()]
    return f"not met: {', '.join(texts)}" if texts else "met"


def describe_miss(measure: str, size: float, requirement: Requirement, axis: str | None = None) -> str:
    """One miss, as `Requirement.misses` has it, in words.

    Args:
        measure: what misses its bound.
        size: by how much.
        requirement: the requirement.
        axis: the axis of the measure, the leading one where None.
    """
    axis = axis or requirement.axis
    whose = f"{axis} " if requirement.others else ""
    if measure == "settling_time":
        side, limit = ("slow" if size > 0 else "fast"), f"{requirement.settling_time:g} s"
        ratio = requirement.aim() * math.exp(size) / requirement.settling_time
        share = f"{100 * abs(ratio - 1):.0f} %" if abs(size) < LARGEST_MISS else "far"
        return f"{whose}{share} too {side} for {'at most ' if requirement.at_most else ''}{limit}"
    if measure in ("settled", "constraints_satisfied"):
        share = with_unit(measure, requirement.settled + size)
        return f"only {share} of the trials {'settle' if measure == 'settled' else 'satisfy your constraints'}"
    return f"{whose}{measure} above {with_unit(measure, getattr(requirement.limits(axis), measure), axis)}"


def with_unit(measure: str, value: float, axis: str = "") -> str:
    """A number of a measure of an axis with its unit."""
    if not math.isfinite(value):
        return "never" if measure == "settling_time" else "infinite"
    if measure == "settling_time":
        return f"{value:.2f} s"
    if measure == "error":
        return f"{math.degrees(value):.2f} deg" if axis == "yaw" else f"{1e3 * value:.2f} mm"
    return f"{100 * value:.1f} %"


def _change(edit: Edit) -> str:
    """What is edited, and the expected value of the measure."""
    unit = f" {edit.unit}" if edit.unit and "unit(" not in edit.unit else ""
    expected = ""
    if edit.expected is not None:
        expected = f", expected {_name(edit.measure)} {with_unit(edit.measure, edit.expected, edit.axis)}"
    return f"{edit.field} {edit.before:g} -> {edit.after:g}{unit}{expected}"


def _origin(edit: Edit) -> str:
    """How the size of an edit was found: the power law that was used, and where it was measured."""
    if edit.rule == HALF_WAY:
        return f"half-way back to {edit.before:g} on a logarithmic scale"
    if edit.expected is None:
        return "the effect cannot be predicted; this is the largest change that the rule allows"
    law = f"{_name(edit.measure)} ~ {edit.field.split('.')[-1]}^{edit.slope:.2g}"
    if edit.between is None:
        return f"{law}, assumed by the rule, not measured"
    low, high = sorted(edit.between)
    inside = low <= min(edit.before, edit.after) and max(edit.before, edit.after) <= high
    texts = {
        "iterations": f"{law}, from the iterations at {low:g} and {high:g}",
        "sensitivity": f"{law}, sensitivity measured from {low:g} to {high:g}{'' if inside else ', extrapolated'}",
        "interpolation": f"interpolated between the iterations at {low:.3g} and {high:.3g}, "
        "of which one is too slow and one too fast",
    }
    return texts[edit.known_from]


def _name(measure: str) -> str:
    return measure.replace("_", " ")
