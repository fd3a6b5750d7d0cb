"""Iterations of a tuning (an edit, a training with it, the response of the policy), and their validations."""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Any

from flytune.tuning.requirement import NO_RESPONSE, ResponseSummary
from flytune.tuning.rules import SYMPTOMS

HALF_WAY = "half-way back"  # instead of a rule's name: the last edit was too large
SAME = 0.01  # two values of a field that differ by a smaller share count as the same


@dataclasses.dataclass(frozen=True, kw_only=True)
class Edit:
    """One change of one field of the task, and the reason for it."""

    rule: str
    source: str
    reason: str
    symptom: str
    field: str
    before: float
    after: float
    unit: str  # of the field, empty where it has none
    expected: float | None  # the measure after the edit; None where it cannot be predicted
    slope: float  # d log(measure) / d log(field) that the prediction uses
    known_from: str  # iterations, interpolation, sensitivity or rule
    between: tuple[float, float] | None  # values of the field that the slope was measured between
    gain: float  # share of the miss that the edit is predicted to remove, 1 at most
    axis: str = ""  # of the measure
    next_best: "Edit | None" = None  # the best edit of another field

    @property
    def measure(self) -> str:
        """The measure that the edit is to change."""
        return SYMPTOMS[self.symptom][0]

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> "Edit":
        """The edit that `dataclasses.asdict` has written."""
        between = tuple(data["between"]) if data["between"] else None
        next_best = cls.from_dict(data["next_best"]) if data["next_best"] else None
        return cls(**{**data, "between": between, "next_best": next_best})


@dataclasses.dataclass(frozen=True, kw_only=True)
class Iteration:
    """One policy of a tuning: the edits it was trained with, and its response."""

    number: int
    values: Mapping[str, float] = dataclasses.field(default_factory=dict)  # field -> value, of all edits so far
    reasons: Mapping[str, str] = dataclasses.field(default_factory=dict)  # field -> reason
    edit: Edit | None = None  # the last edit; None for the first policy
    parent: int | None = None  # number of the iteration that was edited
    response: ResponseSummary = NO_RESPONSE
    trials: int = 0  # trials of the training set when the response was measured
    seconds: float = 0.0  # duration of the training
    diverged: str = ""  # which number became infinite, and where; such an iteration has no policy

    def to_dict(self) -> dict[str, Any]:
        """Plain values."""
        return dataclasses.asdict(self) | {"response": self.response.to_dict()}

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> "Iteration":
        """The iteration that `to_dict` has written."""
        edit = Edit.from_dict(data["edit"]) if data["edit"] else None
        return cls(**{**data, "edit": edit, "response": ResponseSummary.from_dict(data["response"])})


@dataclasses.dataclass(frozen=True, kw_only=True)
class Validation:
    """The result of an iteration on a validation set: initial conditions that the tuning has not used before."""

    iteration: int
    seed: int  # of the validation set
    judgement: dict[str, Any]  # as `evaluate --json` prints it
    misses: dict[str, float]  # as `Requirement.misses` has them; empty where the requirement is met
    axes: Mapping[str, str] = dataclasses.field(default_factory=dict)  # measure -> its axis, where not the leading one


def value_in(iteration: Iteration, field: str, iterations: Sequence[Iteration]) -> float | None:
    """The field's value in an iteration; None where no iteration has edited the field."""
    if field in iteration.values:
        return iteration.values[field]
    return next((each.edit.before for each in iterations if each.edit and each.edit.field == field), None)


def variants(iteration: Iteration, field: str, iterations: Sequence[Iteration]) -> list[tuple[Iteration, float]]:
    """The iterations whose values equal those of `iteration` in all fields but this one, each with its value of it."""
    found = []
    for other in iterations:
        value = value_in(other, field, iterations)
        names = (set(iteration.values) | set(other.values)) - {field}
        if value is not None and all(iteration.values.get(name) == other.values.get(name) for name in names):
            found.append((other, value))
    return found


def already_tried(iteration: Iteration, field: str, value: float, iterations: Sequence[Iteration]) -> Iteration | None:
    """The first iteration that has this value of the field and otherwise the values of `iteration`."""
    same = (other for other, there in variants(iteration, field, iterations) if abs(math.log(there / value)) < SAME)
    return next(same, None)
