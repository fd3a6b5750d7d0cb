"""What a tuning came to: its steps, its verdicts on fresh starts, and why it ended."""

import dataclasses
from pathlib import Path
from typing import Any

from flytune.tuning.iteration import Step
from flytune.tuning.messages import describe_edit, describe_miss, describe_step
from flytune.tuning.requirement import Requirement


@dataclasses.dataclass(frozen=True, kw_only=True)
class Verdict:
    """A step judged on starts the tuning never saw."""

    step: int
    seed: int
    judgement: dict[str, Any]
    misses: dict[str, float]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Tuning:
    """What a tuning came to."""

    requirement: Requirement
    start: str
    steps: list[Step]
    verdicts: list[Verdict]
    best: int
    blocked: list[str]  # why no rule could help, where it ended without success
    directory: Path
    bounds: tuple[str, ...] = ()  # terminations the user has set

    @property
    def met(self) -> bool:
        """Whether the best policy meets the requirement on fresh starts."""
        return any(verdict.step == self.best and not verdict.misses for verdict in self.verdicts)

    def why(self) -> str:
        """What is missing of the best policy, and what stands in the way, in one line."""
        missing = next((verdict.misses for verdict in reversed(self.verdicts) if verdict.step == self.best), {})
        said = ", ".join(describe_miss(name, size, self.requirement) for name, size in missing.items())
        blocked = "; ".join(self.blocked) or "no rule can help"
        return f"not met: {said} (step {self.best}). {blocked}. Best kept in {self.directory}."

    def to_dict(self) -> dict[str, Any]:
        """Plain values for a page.

        Keys: `title` (the requirement as a sentence), `requirement` (its numbers), `start` (name of the first task),
        `met`, `best` (number of the best iteration), `why` (why it is not met, else empty), `directory`, `iterations`
        and `validations`. Each iteration has `number`, `parent` (number of the edited iteration, or None), `edit` and
        `result` (one sentence each), `change` (the edit's own values, or None), `seconds` of training, and `response`
        (settling_time, overshoot, error, settled, constraints_satisfied; None where infinite). Each validation has
        `iteration`, `seed`, `judgement` (as `evaluate --json`) and `misses`.
        """
        iterations, target = [], self.requirement.narrowed()
        for step in self.steps:
            before = self.steps[step.origin].measured if step.origin is not None else None
            response = step.measured.to_dict()
            response["constraints_satisfied"] = response.pop("kept")
            iterations.append(
                {
                    "number": step.number,
                    "parent": step.origin,
                    "edit": describe_edit(step.edit, target) if step.edit else f"start: {self.start}",
                    "result": describe_step(step, before, target, bounds=bool(self.bounds)),
                    "change": dataclasses.asdict(step.edit) if step.edit else None,
                    "seconds": step.seconds,
                    "response": response,
                }
            )
        return {
            "title": str(self.requirement),
            "requirement": self.requirement.to_dict(),
            "start": self.start,
            "met": self.met,
            "best": self.best,
            "why": "" if self.met else self.why(),
            "directory": str(self.directory),
            "iterations": iterations,
            "validations": [
                {"iteration": each.step, "seed": each.seed, "judgement": each.judgement, "misses": each.misses}
                for each in self.verdicts
            ],
        }
