"""The choice of the next edit: the option at any iteration that is predicted to come nearest to the requirement."""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Any

from flytune.config import document, nested
from flytune.errors import BadInput
from flytune.task.task import Task
from flytune.training.trainer import DEFAULT_TRAINER
from flytune.tuning.iteration import HALF_WAY, Edit, Iteration, already_tried
from flytune.tuning.options import find_options
from flytune.tuning.requirement import Requirement
from flytune.tuning.rules import Rule, is_whole
from flytune.tuning.sensitivity import Sensitivities
from flytune.tuning.slopes import Context


def choose(
    iterations: Sequence[Iteration],
    tables: Mapping[str, Any],
    requirement: Requirement,
    rules: Sequence[Rule],
    sensitivities: Sensitivities,
    fixed: Sequence[str],
    trainer: str = DEFAULT_TRAINER,
) -> tuple[Iteration, Edit] | list[str]:
    """The iteration to edit next and its edit; or, where no rule applies, the reasons, one line per symptom.

    Args:
        iterations: all iterations so far; the first one is the start.
        tables: the task of the start, as nested tables.
        requirement: the requirement on the training set.
        rules: the rules that may be used.
        sensitivities: the measured effect of each parameter.
        fixed: field paths the user has set; they, and all fields below them, are not edited.
        trainer: name of the trainer; rules for settings of other trainers are left out.
    """
    context = Context(iterations, tables, requirement, rules, sensitivities, fixed, trainer)
    if (edit := _half_way_back(context)) is not None:
        return iterations[iterations[-1].parent or 0], edit
    nearest = min(iterations, key=lambda each: (requirement.distance(each.response), -each.number))
    options: list[tuple[float, int, Edit]] = []
    refused: dict[str, list[str]] = {}
    for iteration in (each for each in iterations if not each.diverged):
        found, refusals = find_options(context, iteration)
        options += [(distance, -iteration.number, edit) for distance, edit in found]
        refused = refusals if iteration is nearest else refused
    if not options:
        return [f"{symptom}: {', '.join(reasons)}" for symptom, reasons in refused.items()]
    options.sort(key=lambda option: option[:2])
    allowed = (option for option in options if _is_allowed(context, iterations[-option[1]], option[2]))
    chosen = next(allowed, None)
    if chosen is None:
        edits = {f"{edit.rule} ({edit.field} {edit.after:g} is not allowed in this task)" for _, _, edit in options}
        return sorted(edits)
    _, number, best = chosen
    next_best = next((edit for _, other, edit in allowed if other == number and edit.field != best.field), None)
    return iterations[-number], dataclasses.replace(best, next_best=next_best)


def _is_allowed(context: Context, iteration: Iteration, edit: Edit) -> bool:
    """Whether the task remains valid with the edit: one field may limit another, as `wide` limits `narrow`."""
    tables = dict(context.tables)
    for path, value in {**iteration.values, edit.field: edit.after}.items():
        tables = nested.edit(tables, path, round(value) if is_whole(tables, path) else value)
    try:
        document.read(Task, tables)
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
