"""Comparing: judgements of several controllers over the same trials, side by side and trial by trial."""

import dataclasses
from collections.abc import Sequence

from flytune.errors import BadInput
from flytune.evaluation.comparison_table import MAY_DIFFER, comparison_text
from flytune.evaluation.difference import Difference, Metric, compare_metric, metrics_of
from flytune.evaluation.judge import Judgement

SHARED = {  # what has to be the same: how it is called, the option that sets it, and its unit
    "task": ("task", "task", ""),
    "vehicle": ("vehicle", "task", ""),
    "trials": ("trials", "trials", ""),
    "seed": ("seed", "seed", ""),
    "initial_conditions": ("starts", "starts", ""),
    "duration": ("duration", "duration", " s"),
}


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Comparison:
    """Several controllers over the same trials, no two names alike, and how each differs from the reference."""

    judgements: tuple[Judgement, ...]
    reference: int  # which of them the others are compared with
    differences: tuple[Difference, ...]  # per controller but the reference, and per metric

    def __repr__(self) -> str:
        return f"Comparison({', '.join(self.names)}; with {self.names[self.reference]})"

    @property
    def metrics(self) -> tuple[Metric, ...]:
        """What is compared: the tracking error too, where the target moves for all of them."""
        return metrics_of(self.judgements)

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the controllers."""
        return tuple(judgement.name for judgement in self.judgements)

    def to_dict(self) -> dict:
        """The object that `compare --json` prints, of plain Python values; None where a number is infinite."""
        return {
            "schema": 1,
            "reference": self.names[self.reference],
            "controllers": [judgement.to_dict() for judgement in self.judgements],
            "differences": [difference.to_dict() for difference in self.differences],
        }

    def table(self) -> str:
        """The comparison for a terminal: a row per controller, then the differences in words."""
        return comparison_text(self)

    __str__ = table


def compare(judgements: Sequence[Judgement], *, reference: int = 0) -> Comparison:
    """The comparison of two or more controllers over the same trials.

    Initial state and noise of a trial depend on seed and trial alone. So trial i of one controller is paired with
    trial i of the reference, and their difference does not contain the spread of the initial states. Task, vehicle,
    duration and initial conditions are the same for all; the simulator may differ. Names that occur twice are made
    different. `reference` is the index of the controller that the others are compared with.

    Raises:
        BadInput: fewer than two, no such reference, or trials that are not the same.

    Source: docs, definitions.
    """
    if len(judgements) < 2:
        raise BadInput(f"compare: {len(judgements)} controller is not allowed. Allowed: two or more. Name another one.")
    if not 0 <= reference < len(judgements):
        raise BadInput(f"reference: {reference} is not allowed. Allowed: 0 to {len(judgements) - 1}, a controller.")
    named = _distinguish(judgements)
    first = named[0]
    for field, (label, option, unit) in SHARED.items():
        wanted = getattr(first, field)
        for other in named:
            if (value := getattr(other, field)) != wanted:
                raise BadInput(
                    f"{label}: {wanted}{unit} for {first.name} and {value}{unit} for {other.name} is not allowed. "
                    f"Allowed: the same for every controller. Fly all of them with one --{option}."
                )
    against = named[reference]
    others = [controller for controller in named if controller is not against]
    differences = tuple(
        compare_metric(controller, against, metric) for controller in others for metric in metrics_of(named)
    )
    return Comparison(judgements=tuple(named), reference=reference, differences=differences)


def _distinguish(judgements: Sequence[Judgement]) -> list[Judgement]:
    """The judgements, no two names alike: what differs is added to a name, or a number where nothing does."""
    named: dict[str, Judgement] = {}
    for judgement in judgements:
        alike = [other for other in judgements if other.name == judgement.name]
        name = judgement.name or "controller"
        for field in MAY_DIFFER:
            if len({getattr(one, field) for one in alike}) == len(alike) > 1:
                name = f"{name} ({getattr(judgement, field)})"
                break
        unique, number = name, 1
        while unique in named:
            number += 1
            unique = f"{name} ({number})"
        named[unique] = dataclasses.replace(judgement, name=unique)
    return list(named.values())
