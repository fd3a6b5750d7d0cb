"""The loop of a tuning: fly, find what misses the requirement, edit the task by a rule, train, and fly again."""

import dataclasses
import math
import shutil
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from flytune.config import document
from flytune.config.files import write_json, write_text
from flytune.config.nested import first_difference
from flytune.control.policy import Policy, load_policy
from flytune.errors import Diverged
from flytune.runs.directory import has_checkpoint
from flytune.task.task import Task, load_task, write_task
from flytune.training.loop import Progress, train
from flytune.training.trainer import find_trainer
from flytune.tuning import messages
from flytune.tuning.choose import choose
from flytune.tuning.history import VALIDATION_SEED, VALIDATION_TRIALS, History
from flytune.tuning.iteration import Edit, Iteration, Validation
from flytune.tuning.requirement import Requirement, ResponseSummary
from flytune.tuning.result import Tuning
from flytune.tuning.rules import Rule, is_whole
from flytune.tuning.sensitivity import load_sensitivities
from flytune.tuning.start import edited, find_start, fly_for, tuning_duration

DIVERGED = ResponseSummary(
    settling_time=math.inf, overshoot=math.inf, error=math.inf, settled=0.0, constraints_satisfied=0.0
)


class Tuner:
    """A tuning in progress.

    The journal `tune.json` is written after every iteration and every validation, so that an interrupted tuning can be
    resumed.
    """

    def __init__(
        self,
        requirement: Requirement,
        rules: Sequence[Rule],
        out: Path,
        *,
        task: str | None,
        edits: Mapping[str, Any],
        seed: int,
        trainer: str,
        most_iterations: int,
        on_message: Callable[[str], None],
        on_progress: Callable[[Progress], None] | None,
    ) -> None:
        """Find the start; the arguments are those of `tune`, `rules` are all rules that may be used.

        Raises:
            BadInput: an argument cannot be used, or no controller can meet the requirement; nothing was written.
        """
        self.requirement, self.rules, self.out = requirement, rules, out
        self.edits, self.seed, self.trainer, self.most_iterations = dict(edits), seed, trainer, most_iterations
        self.on_message, self.on_progress = on_message, on_progress
        self.target = requirement.tightened()  # on the training set
        self.duration = tuning_duration(requirement)
        self.sensitivities = load_sensitivities()
        self.start = find_start(requirement, task, self.edits, trainer)
        self.tables = document.plain(self.start.task)
        self.constraints = tuple(
            name
            for name in self.start.task.termination
            if any(f"{path}.".startswith(f"termination.{name}.") or path == "termination" for path in edits)
        )
        self.history = History(
            out,
            {
                "requirement": requirement.to_dict(), "task": task, "edits": self.edits, "seed": seed,
                "trainer": trainer, "rules": [dataclasses.asdict(rule) for rule in rules],
                "tables": {name: table for name, table in self.tables.items() if name != "sources"},
            },
        )  # fmt: skip

    def run(self) -> Tuning:
        """The result, once the requirement is met on a validation set or no further edit can be made."""
        self._announce()
        history = self.history
        if not history.iterations:
            self._write()
            self.begin()
        while (met := history.met_by()) is None:
            self._measure_again()
            if (candidate := history.candidate(self.target)) is not None:
                self.validate(candidate)
                continue
            chosen = [f"{self.most_iterations} edits were made, which is the limit"]
            if len(history.iterations) <= self.most_iterations:
                chosen = choose(
                    history.iterations, self.tables, self.target, self.rules, self.sensitivities, tuple(self.edits),
                    trainer=self.trainer,
                )  # fmt: skip
            if not isinstance(chosen, list):
                self._apply(*chosen)
                continue
            best = history.nearest(self.requirement, self.target)
            if history.validated(best.number):
                return self._end(best.number, chosen)
            self.validate(best)
        return self._end(met, [])

    def begin(self) -> None:
        """The first iteration: the policy of the nearest known task, or a training of the task where none is known."""
        start = self.start
        if start.files is None or start.judgement is None:
            self._say("start", f"{start.name}: no policy for this task is known; it is trained from new weights")
            self.train(0, {}, {}, None, None)
            return
        self._say("start", messages.describe_start(start.name, start.times, self.duration))
        folder = self.history.folder(0)
        folder.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(start.files[0], folder / "policy.safetensors")
        shutil.copyfile(start.files[1], folder / "run.json")
        write_text(folder / "task.toml", write_task(start.task))
        response = self.requirement.measure(start.judgement, constraints=self.constraints)
        self._keep(
            Iteration(
                number=0, values={}, reasons={}, edit=None, parent=None, response=response,
                trials=self.history.training_trials(), seconds=0.0,
            )
        )  # fmt: skip

    def train(
        self, number: int, values: dict[str, float], reasons: dict[str, str], edit: Edit | None, parent: int | None
    ) -> None:
        """One more iteration: train and fly the task of the start with some values changed.

        Args:
            number: of the new iteration.
            values: field -> value, of all edits so far.
            reasons: field -> reason.
            edit: the last edit, None for the first iteration.
            parent: number of the iteration whose policy the training starts from, None for new weights.

        Raises:
            Diverged: the first training diverged.
        """
        task = self.task_of(number, values, reasons)
        initial = None
        if find_trainer(self.trainer).supports_warm_start and parent is not None:
            initial = load_policy(self.history.folder(parent) / "policy.safetensors")
        diverged, seconds = "", 0.0
        try:
            policy, seconds = self.learn(task, initial, self.history.folder(number))
            response = self._measure(policy, task)
        except Diverged as error:
            if parent is None:
                raise
            diverged, response = str(error), DIVERGED
        self._keep(
            Iteration(
                number=number, values=values, reasons=reasons, edit=edit, parent=parent, response=response,
                trials=self.history.training_trials(), seconds=seconds, diverged=diverged,
            )
        )  # fmt: skip

    def learn(self, task: Task, initial: Policy | None, folder: Path) -> tuple[Policy, float]:
        """The policy of a training in `folder`, resumed where it was interrupted, and its duration in s."""
        resumable = has_checkpoint(folder)
        if resumable:  # another version of flytune may have chosen another edit
            resumable = first_difference(document.plain(load_task(folder / "task.toml")), document.plain(task)) is None
        if folder.exists() and not resumable:
            shutil.rmtree(folder)
        run = train(
            task, self.trainer, seed=self.seed, out=folder, resume=resumable, warm_start=initial,
            on_progress=self.on_progress,
        )  # fmt: skip
        return run.policy, run.metrics[-1]["seconds"]

    def task_of(self, number: int, values: Mapping[str, float], reasons: Mapping[str, str]) -> Task:
        """The task of an iteration: that of the start with these values."""
        if number == 0 and self.start.files is None:
            return self.start.first
        changes = {
            path: (round(value) if is_whole(self.tables, path) else value, reasons[path])
            for path, value in values.items()
        }
        return edited(self.start.task, changes)

    def validate(self, iteration: Iteration) -> Validation:
        """The result of an iteration on a validation set of its own."""
        seed = VALIDATION_SEED + len(self.history.validations)
        policy = load_policy(self.history.folder(iteration.number) / "policy.safetensors")
        task = self.task_of(iteration.number, iteration.values, iteration.reasons)
        judgement = fly_for(self.requirement, policy, task, seed, VALIDATION_TRIALS)
        response = self.requirement.measure(judgement, constraints=self.constraints)
        validation = Validation(
            iteration=iteration.number, seed=seed, judgement=judgement.to_dict(),
            misses=self.requirement.misses(response),
        )  # fmt: skip
        self.history.validations.append(validation)
        self._write()
        text = messages.describe(response, self.requirement, bounds=bool(self.constraints))
        outcome = messages.describe_misses(validation.misses, self.requirement)
        self._say(
            "validation",
            f"iteration {iteration.number} in {VALIDATION_TRIALS} trials with new initial conditions: {text}; "
            f"{outcome}",
        )
        return validation

    def _announce(self) -> None:
        """Print the requirement, and all iterations of a resumed tuning."""
        trials = self.history.training_sets()[0][1]
        self._say("requirement", str(self.requirement))
        self._say("training set", messages.describe_target(self.target, trials, self.duration))
        if self.edits:
            self._say("fixed", messages.describe_fixed(self.edits, self.requirement, self.constraints))
        for iteration in self.history.iterations:
            self._report(iteration)

    def _measure(self, policy: Policy, task: Task) -> ResponseSummary:
        """The response of a policy on the training set."""
        judgements = [fly_for(self.requirement, policy, task, *each) for each in self.history.training_sets()]
        return self.requirement.measure(*judgements, constraints=self.constraints)

    def _measure_again(self) -> None:
        """Measure every iteration again whose response is not of the whole training set."""
        history, trials = self.history, self.history.training_trials()
        for index, each in enumerate(history.iterations):
            if each.trials == trials or each.diverged:
                continue
            policy = load_policy(history.folder(each.number) / "policy.safetensors")
            response = self._measure(policy, self.task_of(each.number, each.values, each.reasons))
            history.iterations[index] = dataclasses.replace(each, response=response, trials=trials)
            if each.number == history.validations[-1].iteration:
                text = messages.describe_iteration(
                    history.iterations[index], None, self.target, bounds=bool(self.constraints)
                )
                self._say(
                    "training set",
                    f"now {trials} trials, because a failed validation set joins it; iteration {each.number}: {text}",
                )
        self._write()

    def _apply(self, parent: Iteration, edit: Edit) -> None:
        """Make an edit, and train with it."""
        number = len(self.history.iterations)
        self._say(f"edit {number}", f"of iteration {parent.number}, {messages.describe_edit(edit, self.target)}")
        so_far = parent.reasons.get(edit.field, f"tuned: {edit.before:g}").split(",")[0]
        reason = f"{so_far} -> {edit.after:g}, {edit.symptom}: {edit.reason} ({edit.rule}, {edit.source})"
        values, reasons = {**parent.values, edit.field: edit.after}, {**parent.reasons, edit.field: reason}
        self.train(number, values, reasons, edit, parent.number)

    def _keep(self, iteration: Iteration) -> None:
        self.history.iterations.append(iteration)
        self._write()
        self._report(iteration)

    def _report(self, iteration: Iteration) -> None:
        before = self.history.iterations[iteration.parent].response if iteration.parent is not None else None
        text = messages.describe_iteration(iteration, before, self.target, bounds=bool(self.constraints))
        self._say(f"iteration {iteration.number}", text)

    def _say(self, topic: str, text: str) -> None:
        self.on_message(messages.line(topic, text))

    def _end(self, best: int, stopped_because: list[str]) -> Tuning:
        """The result; the files of the best policy are copied to where a run directory has them."""
        history, folder, iteration = self.history, self.history.folder(best), self.history.iterations[best]
        for name in ("policy.safetensors", "policy-last.safetensors", "metrics.jsonl", "run.json"):
            if (folder / name).exists():
                shutil.copyfile(folder / name, self.out / name)
        task = self.task_of(iteration.number, iteration.values, iteration.reasons)
        write_text(self.out / "task.toml", write_task(task))
        judgement = next((each.judgement for each in reversed(history.validations) if each.iteration == best), None)
        if judgement is not None:
            write_json(self.out / "evaluation.json", judgement)
        result = Tuning(
            requirement=self.requirement, start=self.start.name, iterations=history.iterations,
            validations=history.validations, best=best, stopped_because=stopped_because, directory=self.out,
            constraints=self.constraints,
        )  # fmt: skip
        self._write({"best": best, "met": result.met, "stopped_because": stopped_because})
        return result

    def _write(self, end: Mapping[str, Any] | None = None) -> None:
        self.history.write({"start": self.start.name, "duration": self.duration, **(end or {})})
