"""The loop of a tuning: fly, find what misses the requirement, edit the task by a rule, train, and fly again."""

import dataclasses
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from flytune.config import document
from flytune.config.files import write_json, write_text
from flytune.config.nested import first_difference
from flytune.control.policy import Policy, load_policy, save_policy
from flytune.errors import Diverged
from flytune.evaluation.evaluate import Evaluation, evaluate
from flytune.evaluation.judge import Judgement
from flytune.runs.directory import has_checkpoint
from flytune.task.files import load_task, write_task
from flytune.task.task import Task
from flytune.training.progress import Progress
from flytune.training.trainer import find_trainer
from flytune.tuning import messages
from flytune.tuning.choose import choose
from flytune.tuning.flying import fly_for
from flytune.tuning.history import VALIDATION_SEED, VALIDATION_TRIALS, History
from flytune.tuning.iteration import Edit, Iteration, Validation
from flytune.tuning.requirement import Requirement, ResponseSummary, constraints_of
from flytune.tuning.result import Tuning
from flytune.tuning.rules import Rule, edited, to_dicts
from flytune.tuning.sensitivity import load_sensitivities
from flytune.tuning.slopes import Context
from flytune.tuning.start import find_start


@dataclasses.dataclass(kw_only=True)
class Tuner:
    """A tuning in progress; its arguments are those of `tune`, except that `rules` are all rules that may be used.

    The journal `tune.json` is written after every iteration and every validation, so that an interrupted tuning can be
    resumed.

    Raises:
        BadInput: an argument cannot be used, or no controller can meet the requirement; nothing was written.
    """

    requirement: Requirement
    rules: Sequence[Rule]
    out: Path
    task: str | None
    edits: dict[str, Any]
    seed: int
    trainer: str
    most_iterations: int
    on_message: Callable[[str], None]
    on_progress: Callable[[Progress], None] | None

    def __post_init__(self) -> None:
        self.target = self.requirement.tightened()  # on the training set
        self.validated: dict[int, Evaluation] = {}  # iteration -> its last validation, of this process
        self.duration = self.requirement.trial_duration()
        self.sensitivities = load_sensitivities()
        self.start = find_start(self.requirement, self.task, self.edits, self.trainer)
        self.tables = document.plain(self.start.task)
        self.constraints = constraints_of(self.start.task, self.edits)
        self.history = History(
            self.out,
            asked={
                "requirement": dataclasses.asdict(self.requirement), "task": self.task, "edits": self.edits,
                "seed": self.seed, "trainer": self.trainer, "rules": to_dicts(self.rules),
                "tables": {name: table for name, table in self.tables.items() if name != "sources"},
            },
            facts={"start": self.start.name, "duration": self.duration},
        )  # fmt: skip

    def run(self) -> Tuning:
        """The result, once the requirement is met on a validation set or no further edit can be made."""
        self._announce()
        history = self.history
        if not history.iterations:
            history.write()
            self.begin()
        while (met := history.met_by()) is None:
            self._measure_again()
            if (candidate := history.candidate(self.target) or self._untrained_candidate()) is not None:
                self.validate(candidate)
                continue
            chosen = [f"{self.most_iterations} edits were made, which is the limit"]
            if len(history.iterations) <= self.most_iterations:
                chosen = choose(
                    Context(
                        history.iterations, self.tables, self.target, self.rules, self.sensitivities,
                        tuple(self.edits), self.trainer,
                    )
                )  # fmt: skip
            if not isinstance(chosen, list):
                self._apply(*chosen)
                continue
            best = history.nearest(self.requirement, self.target)
            if history.validated(best.number):
                return self._end(best.number, chosen)
            self.validate(best)
        return self._end(met, [])

    def _untrained_candidate(self) -> Iteration | None:
        """The policy with a dial, where it meets the requirement but not the stricter one of the training set.

        To validate it once costs less than the training that would come next.
        """
        first = self.history.iterations[0]
        if not self.start.setting or self.history.validated(0) or self.requirement.misses(first.response):
            return None
        return first

    def begin(self) -> None:
        """Add the first iteration: the policy of the nearest known task, or a training where none is known."""
        start, first = self.start, Iteration(number=0)
        if start.policy is None or start.record is None or start.judgement is None:
            self._say("start", messages.describe_first_training(start.name, start.trained_for, bool(start.initial)))
            self.train(first)
            return
        self._say("start", messages.describe_start(start.name, start.times, start.setting, self.duration))
        folder = self.history.folder(0)
        folder.mkdir(parents=True, exist_ok=True)
        save_policy(folder / "policy.safetensors", start.policy)
        shutil.copyfile(start.record, folder / "run.json")
        write_text(folder / "task.toml", write_task(start.task))
        self._keep(dataclasses.replace(first, response=self._response(start.judgement)))

    def train(self, planned: Iteration) -> None:
        """Add an iteration: train the task with the planned values, from the policy of the parent, and fly the result.

        Raises:
            Diverged: the first training diverged.
        """
        task = self.task_of(planned)
        initial = self.start.initial if planned.parent is None else None
        if find_trainer(self.trainer).tuning_goes_on and planned.parent is not None:
            initial = self._policy(planned.parent)
        seconds = 0.0
        try:
            policy, seconds = self.learn(task, initial, self.history.folder(planned.number))
            done = dataclasses.replace(planned, response=self._measure(policy, task))
        except Diverged as error:
            if planned.parent is None:
                raise
            done = dataclasses.replace(planned, diverged=str(error))
        self._keep(dataclasses.replace(done, seconds=seconds))

    def learn(self, task: Task, initial: Policy | None, folder: Path) -> tuple[Policy, float]:
        """The policy of a training in `folder`, resumed where it was interrupted, and its duration in s."""
        from flytune.training.loop import train  # takes a third of a second, which most tunings do not need

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

    def task_of(self, iteration: Iteration) -> Task:
        """The task of an iteration: that of the start with the values of the iteration."""
        if iteration.number == 0 and self.start.policy is None and self.start.initial is None:
            return self.start.first
        return edited(self.tables, iteration.values, iteration.reasons)

    def validate(self, iteration: Iteration) -> Validation:
        """The result of an iteration on a validation set of its own."""
        seed = VALIDATION_SEED + len(self.history.validations)
        policy, task = self._policy(iteration.number), self.task_of(iteration)
        flown = evaluate(policy, task, name=str(self.out), trials=VALIDATION_TRIALS, seed=seed, duration=self.duration)
        self.validated[iteration.number], judgement = flown, flown.judgement
        response = self._response(judgement)
        validation = Validation(
            iteration=iteration.number, seed=seed, judgement=judgement.to_dict(),
            misses=self.requirement.misses(response), axes=response.axes,
        )  # fmt: skip
        self.history.validations.append(validation)
        self.history.write()
        text = messages.describe(response, self.requirement, bounds=bool(self.constraints))
        outcome = messages.describe_misses(validation.misses, self.requirement, response.axes)
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

    def _policy(self, number: int) -> Policy:
        return load_policy(self.history.folder(number) / "policy.safetensors")

    def _response(self, *judgements: Judgement) -> ResponseSummary:
        return self.requirement.measure(*judgements, constraints=self.constraints)

    def _measure(self, policy: Policy, task: Task) -> ResponseSummary:
        """The response of a policy on the training set."""
        return self._response(
            *(fly_for(self.requirement, policy, task, *each) for each in self.history.training_sets())
        )

    def _measure_again(self) -> None:
        """Measure every iteration again whose response is not of the whole training set."""
        history, trials = self.history, self.history.training_trials()
        for index, each in enumerate(history.iterations):
            if each.trials == trials or each.diverged:
                continue
            response = self._measure(self._policy(each.number), self.task_of(each))
            history.iterations[index] = dataclasses.replace(each, response=response, trials=trials)
            if each.number == history.validations[-1].iteration:
                text = messages.describe_iteration(
                    history.iterations[index], None, self.target, bounds=bool(self.constraints)
                )
                self._say(
                    "training set",
                    f"now {trials} trials, because a failed validation set joins it; iteration {each.number}: {text}",
                )
        history.write()

    def _apply(self, parent: Iteration, edit: Edit) -> None:
        """Make an edit, and train with it."""
        number = len(self.history.iterations)
        self._say(f"edit {number}", f"of iteration {parent.number}, {messages.describe_edit(edit)}")
        so_far = parent.reasons.get(edit.field, f"tuned: {edit.before:g}").split(",")[0]
        reason = f"{so_far} -> {edit.after:g}, {edit.symptom}: {edit.reason} ({edit.rule}, {edit.source})"
        values, reasons = {**parent.values, edit.field: edit.after}, {**parent.reasons, edit.field: reason}
        self.train(Iteration(number=number, values=values, reasons=reasons, edit=edit, parent=parent.number))

    def _keep(self, iteration: Iteration) -> None:
        """Add an iteration that was measured on the training set."""
        iteration = dataclasses.replace(iteration, trials=self.history.training_trials())
        self.history.iterations.append(iteration)
        self.history.write()
        self._report(iteration)

    def _report(self, iteration: Iteration) -> None:
        before = self.history.iterations[iteration.parent].response if iteration.parent is not None else None
        text = messages.describe_iteration(iteration, before, self.target, bounds=bool(self.constraints))
        self._say(f"iteration {iteration.number}", text)

    def _say(self, topic: str, text: str) -> None:
        self.on_message(messages.line(topic, text))

    def _end(self, best: int, stopped_because: list[str]) -> Tuning:
        """The result; the files of the best policy are copied to where a run directory has them."""
        history, folder = self.history, self.history.folder(best)
        for name in ("policy.safetensors", "policy-last.safetensors", "metrics.jsonl", "run.json"):
            if (folder / name).exists():
                shutil.copyfile(folder / name, self.out / name)
        write_text(self.out / "task.toml", write_task(self.task_of(history.iterations[best])))
        result = Tuning(
            requirement=self.requirement, start=self.start.name, iterations=history.iterations,
            validations=history.validations, best=best, stopped_because=stopped_because, directory=self.out,
            constraints=self.constraints,
        )  # fmt: skip
        if (validation := result.last_validation) is not None:
            write_json(self.out / "evaluation.json", validation.judgement)
        history.facts |= {"best": best, "met": result.met, "stopped_because": stopped_because}
        history.write()
        return result
