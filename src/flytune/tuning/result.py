"""The result of a tuning: its iterations, its validations, and why it ended."""

import dataclasses
from pathlib import Path
from typing import Any

from flytune.tuning.iteration import Iteration, Validation
from flytune.tuning.messages import describe_edit, describe_iteration, describe_misses
from flytune.tuning.requirement import Requirement


@dataclasses.dataclass(frozen=True, kw_only=True)
class Tuning:
    """The result of a tuning."""

    requirement: Requirement
    start: str  # name of the task it began with
    iterations: list[Iteration]
    validations: list[Validation]
    best: int  # number of the best iteration
    stopped_because: list[str]  # why no further edit was made, where the requirement is not met
    directory: Path  # the run directory of the best policy
    constraints: tuple[str, ...] = ()  # terminations the user has set

    @property
    def met(self) -> bool:
        """Whether the best policy meets the requirement on a validation set."""
        return any(each.iteration == self.best and not each.misses for each in self.validations)

    @property
    def last_validation(self) -> Validation | None:
        """The last validation of the best policy, None without one."""
        return next((each for each in reversed(self.validations) if each.iteration == self.best), None)

    def why(self) -> str:
        """What misses the requirement in the best iteration, and why no further edit was made, in one line."""
        last = self.last_validation
        misses = describe_misses(last.misses, self.requirement, last.axes) if last else "met"
        reasons = "; ".join(self.stopped_because) or "no rule applies"
        return (
            f"{misses} (iteration {self.best}). The tuning stopped: {reasons}. The best policy is in {self.directory}."
        )

    def __repr__(self) -> str:
        outcome = "met" if self.met else "not met"
        return (
            f"Tuning({self.requirement}: {outcome}, iteration {self.best} of {len(self.iterations)}, {self.directory})"
        )

    def to_dict(self) -> dict[str, Any]:
        """Plain values for a page.

        Keys: `title` (the requirement as a sentence), `requirement` (its numbers), `start` (name of the first task),
        `met`, `best` (number of the best iteration), `why` (why it is not met, else empty), `directory`, `iterations`
        and `validations`. Each iteration has `number`, `parent` (number of the edited iteration, or None), `edit` and
        `result` (one sentence each), `change` (the fields of `Edit`, or None), `seconds` of training, and `response`
        (the fields of `ResponseSummary`; None where infinite). Each validation has the fields of `Validation`.
        """
        iterations, target = [], self.requirement.tightened()
        for each in self.iterations:
            before = self.iterations[each.parent].response if each.parent is not None else None
            iterations.append(
                {
                    "number": each.number,
                    "parent": each.parent,
                    "edit": describe_edit(each.edit) if each.edit else f"start: {self.start}",
                    "result": describe_iteration(each, before, target, bounds=bool(self.constraints)),
                    "change": dataclasses.asdict(each.edit) if each.edit else None,
                    "seconds": each.seconds,
                    "response": each.response.to_dict(),
                }
            )
        return {
            "title": str(self.requirement),
            "requirement": dataclasses.asdict(self.requirement),
            "start": self.start,
            "met": self.met,
            "best": self.best,
            "why": "" if self.met else self.why(),
            "directory": str(self.directory),
            "iterations": iterations,
            "validations": [dataclasses.asdict(each) for each in self.validations],
        }
