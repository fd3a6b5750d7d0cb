"""What a tuning is made of: edits of the task, and the policies that came of them."""

import dataclasses
from collections.abc import Mapping
from typing import Any

from flytune.tuning.requirement import Measured
from flytune.tuning.rules import CONDITIONS

HALF_WAY = "back half-way"  # instead of a rule's name: the last edit went too far


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
    unit: str  # of the field, empty where it has none
    expects: float | None  # of the rule's measure; None where no number can be promised
    slope: float  # d log(measure) / d log(field) that is counted on
    known_from: str  # flown, between, map or rule
    ends: tuple[float, float] | None  # values of the field that the slope was measured between
    gain: float  # share of what is missing of the measure that the edit promises, 1 at most
    second: "Edit | None" = None  # of another field, the next best

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
    looks: int  # sets of starts it was measured on
    seconds: float  # of training
    diverged: str = ""  # what became infinite where; such a step has no policy

    def to_dict(self) -> dict[str, Any]:
        """Plain values."""
        return dataclasses.asdict(self) | {"measured": self.measured.to_dict()}

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> "Step":
        """The inverse of `to_dict`."""
        edit = read_edit(data["edit"])
        return cls(**{**data, "edit": edit, "measured": Measured.from_dict(data["measured"])})


def read_edit(data: dict[str, Any] | None) -> Edit | None:
    """An edit from its plain values, None from None."""
    if not data:
        return None
    ends = tuple(data["ends"]) if data["ends"] else None
    return Edit(**{**data, "ends": ends, "second": read_edit(data["second"])})
