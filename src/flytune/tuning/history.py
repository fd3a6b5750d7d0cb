"""The history of a tuning: its iterations, its validations, and the journal tune.json that holds them on disk."""

import dataclasses
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from flytune.config.files import make_folder, write_json
from flytune.errors import BadInput
from flytune.tuning.iteration import Iteration, Validation
from flytune.tuning.requirement import Requirement

SCHEMA = 3  # of tune.json
TRAINING_SEED, TRAINING_TRIALS = 3000, 100  # the first training set
VALIDATION_SEED, VALIDATION_TRIALS = 4000, 200  # the first validation set; each further one has the next seed
MOST_VALIDATIONS = 3  # of one iteration


@dataclasses.dataclass
class History:
    """Everything a tuning has tried so far, in its directory.

    The training set is the set of initial conditions on which all iterations are compared. A validation set that an
    iteration fails on joins the training set, so that no later validation is a repetition of it.
    """

    directory: Path
    asked: Mapping[str, Any]  # the arguments of the tuning; a resumed tuning must have the same
    facts: dict[str, Any]  # further entries of the journal
    iterations: list[Iteration] = dataclasses.field(default_factory=list)
    validations: list[Validation] = dataclasses.field(default_factory=list)

    def folder(self, number: int) -> Path:
        """The run directory of one iteration."""
        return self.directory / "iterations" / f"{number:02d}"

    def training_sets(self) -> list[tuple[int, int]]:
        """Seed and number of trials of each part of the training set."""
        failed = [(each.seed, VALIDATION_TRIALS) for each in self.validations if each.misses]
        return [(TRAINING_SEED, TRAINING_TRIALS), *failed]

    def training_trials(self) -> int:
        """Number of trials of the training set."""
        return sum(trials for _, trials in self.training_sets())

    def met_by(self) -> int | None:
        """The number of the first iteration that met the requirement on a validation set, None without one."""
        return next((each.iteration for each in self.validations if not each.misses), None)

    def validated(self, number: int) -> int:
        """How often an iteration was validated."""
        return sum(each.iteration == number for each in self.validations)

    def candidate(self, target: Requirement) -> Iteration | None:
        """The last iteration that meets the target on the training set and may be validated, None without one."""
        ready = [
            each
            for each in self.iterations
            if not each.diverged and self.validated(each.number) < MOST_VALIDATIONS and not target.misses(each.response)
        ]
        return ready[-1] if ready else None

    def nearest(self, requirement: Requirement, target: Requirement) -> Iteration:
        """The iteration nearest to the requirement; of several that meet it, one that was not validated yet."""

        def order(each: Iteration) -> tuple[float, bool, float, int]:
            distance, left = requirement.distance(each.response), target.distance(each.response)
            return distance, self.validated(each.number) > 0, left, each.number

        return min((each for each in self.iterations if not each.diverged), key=order)

    def write(self) -> None:
        """Write the journal, whole or not at all.

        Raises:
            BadInput: the directory cannot be written.
        """
        journal = {
            "schema": SCHEMA, **self.asked, **self.facts, "iterations": [each.to_dict() for each in self.iterations],
            "validations": [dataclasses.asdict(each) for each in self.validations],
        }  # fmt: skip
        make_folder(self.directory)
        write_json(self.directory / "tune.json", journal)

    def read(self) -> None:
        """Read the iterations and validations of the journal.

        Raises:
            BadInput: there is no journal, it is damaged or of another version, or the arguments were different.
        """
        path, again = self.directory / "tune.json", "Tune again into another directory."
        try:
            journal = json.loads(path.read_text(encoding="utf-8"))
            if journal["schema"] != SCHEMA:
                raise BadInput(f"resume: {path} has schema {journal['schema']}. Allowed: schema {SCHEMA}. {again}")
            self.iterations = [Iteration.from_dict(each) for each in journal["iterations"]]
            self.validations = [Validation(**each) for each in journal["validations"]]
            before = {name: journal[name] for name in self.asked}
        except BadInput:
            raise
        except OSError:
            raise BadInput(f"resume: {self.directory} holds no tuning. Leave out --resume to start one.") from None
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise BadInput(f"resume: {path} is damaged ({error}). {again}") from None
        now = json.loads(json.dumps(self.asked))
        changed = ["task" if name == "tables" else name for name in now if now[name] != before[name]]
        if changed:
            raise BadInput(
                f"resume: {self.directory} was tuned with another {changed[0]}. Give the same, or another directory."
            )
