"""The choice of the next edit: the option at any iteration that is predicted to come nearest to the requirement."""

import dataclasses
import math

from flytune.errors import BadInput
from flytune.tuning.iteration import HALF_WAY, Edit, Iteration, already_tried
from flytune.tuning.options import find_options
from flytune.tuning.rules import edited
from flytune.tuning.slopes import Context


def choose(context: Context) -> tuple[Iteration, Edit] | list[str]:
    """The iteration to edit next and its edit; or, where no rule applies, the reasons, one line per symptom."""
    iterations, requirement = context.iterations, context.requirement
    if (edit := _half_way_back(context)) is not None:
        return iterations[iterations[-1].parent or 0], edit
    nearest = min(iterations, key=lambda each: (requirement.distance(each.response), -each.number))
    options: list[tuple[float, Iteration, Edit]] = []
    refused: dict[str, list[str]] = {}
    for iteration in iterations:
        if iteration.diverged:
            continue
        found, refusals = find_options(context, iteration)
        options += [(distance, iteration, edit) for distance, edit in found]
        if iteration is nearest:
            refused = refusals
    if not options:
        return [f"{symptom}: {', '.join(reasons)}" for symptom, reasons in refused.items()]
    options.sort(key=lambda option: (option[0], -option[1].number))
    allowed = ((iteration, edit) for _, iteration, edit in options if _is_allowed(context, iteration, edit))
    chosen = next(allowed, None)
    if chosen is None:
        return sorted(
            {f"{edit.rule} ({edit.field} {edit.after:g} is not allowed in this task)" for *_, edit in options}
        )
    iteration, best = chosen
    next_best = next((edit for other, edit in allowed if other is iteration and edit.field != best.field), None)
    return iteration, dataclasses.replace(best, next_best=next_best)


def _is_allowed(context: Context, iteration: Iteration, edit: Edit) -> bool:
    """Whether the task remains valid with the edit: one field may limit another, as `wide` limits `narrow`."""
    try:
        edited(context.tables, {**iteration.values, edit.field: edit.after}, {})
    except BadInput:
        return False
    return True


def _half_way_back(context: Context) -> Edit | None:
    """Half of the last edit, where that edit made trials unsettled that had settled before; else None."""
    last, requirement = context.iterations[-1], context.requirement
    if last.edit is None or last.parent is None or last.edit.rule == HALF_WAY or last.edit.measure == "settled":
        return None
    parent = context.iterations[last.parent]
    lost = requirement.misses(last.response).get("settled", 0.0)
    if lost > -0.05 or requirement.misses(parent.response).get("settled", 0.0) < lost / 2:
        return None
    before, after = last.edit.before, last.edit.after
    middle = float(f"{math.sqrt(before * after):.3g}")
    if abs(math.log(middle / before)) < 0.03:
        return None
    if already_tried(parent, last.edit.field, middle, context.iterations) is not None:
        return None
    return dataclasses.replace(
        last.edit, rule=HALF_WAY, source="flytune", after=middle, expected=None, next_best=None,
        reason=f"after {last.edit.rule} only {last.response.settled:.0%} of the trials settled",
    )  # fmt: skip
