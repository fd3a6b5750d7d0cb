"""The closed loop: fly, see what is missing, edit the task by a rule, train on from the last policy, and fly again."""

import dataclasses
import math
import os
import shutil
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from flytune.config import document
from flytune.config.files import write_json, write_text
from flytune.control.policy import Policy, load_policy
from flytune.errors import BadInput, Diverged, Interrupted
from flytune.runs.directory import first_difference, has_checkpoint
from flytune.task.task import Task, load_task, write_task
from flytune.training.loop import Progress, train
from flytune.training.trainer import DEFAULT_TRAINER, find_trainer
from flytune.tuning.choose import choose
from flytune.tuning.iteration import Edit, Step
from flytune.tuning.journal import read_journal, write_journal
from flytune.tuning.messages import describe, describe_edit, describe_miss, describe_step, describe_targets
from flytune.tuning.requirement import Measured, Requirement
from flytune.tuning.result import Tuning, Verdict
from flytune.tuning.rules import Rule, is_whole
from flytune.tuning.sensitivity import load_effects
from flytune.tuning.start import TUNING_SEED, TUNING_TRIALS, edited, find_start, fly_for, tuning_duration

FRESH_SEED, FRESH_TRIALS = 4000, 200  # the starts of a verdict; each verdict has its own
MOST_STEPS = 12
MOST_VERDICTS = 3  # on one step
LOST = Measured(settling_time=math.inf, overshoot=math.inf, error=math.inf, settled=0.0, kept=0.0)

Tell = Callable[[str], None]


class Tuner:
    """A tuning under way: everything that was decided before the loop, and what it has seen so far.

    `tune.json` in the directory is written after every step, so that an interruption loses none.
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
        most_steps: int,
        tell: Tell,
        on_progress: Callable[[Progress], None] | None,
    ) -> None:
        self.requirement, self.rules, self.out = requirement, rules, out
        self.edits, self.seed, self.trainer, self.most_steps = dict(edits), seed, trainer, most_steps
        self.fixed = tuple(self.edits)
        self.tell, self.on_progress = tell, on_progress
        self.asked = {
            "requirement": requirement.to_dict(), "task": task, "edits": self.edits, "seed": seed,
            "trainer": trainer, "rules": [dataclasses.asdict(rule) for rule in rules],
        }  # fmt: skip
        self.target = requirement.narrowed()  # on the tuning starts
        self.duration = tuning_duration(requirement)
        self.effects = load_effects()
        self.steps: list[Step] = []
        self.verdicts: list[Verdict] = []
        self.start = find_start(requirement, task, self.edits, trainer)
        self.tables = document.plain(self.start.task)
        self.asked["tables"] = {name: table for name, table in self.tables.items() if name != "sources"}
        self.bounds = tuple(
            name
            for name in self.start.task.termination
            if any(f"{path}.".startswith(f"termination.{name}.") or path == "termination" for path in edits)
        )

    # the loop

    def run(self) -> Tuning:
        """Steps until the requirement is met on fresh starts, or nothing can help."""
        self.tell(f"asked    {self.requirement}")
        self.tell(f"tuning   for {describe_targets(self.target, TUNING_TRIALS, self.duration)}")
        if self.edits:
            fixed = ", ".join(f"{path} = {value}" for path, value in self.edits.items())
            kept = f"; kept in {100 * self.requirement.settled:g} % of the trials: {', '.join(self.bounds)}"
            self.tell(f"fixed    by you: {fixed}{kept if self.bounds else ''}")
        for step in self.steps:
            self._say(step)
        if not self.steps:
            self._write()
            self.begin()
        while True:
            if met := [verdict.step for verdict in self.verdicts if not verdict.misses]:
                return self._end(met[0], [])
            self._look_again()
            if ready := [step for step in self.steps if self._is_ready(step)]:
                self.verdict(ready[-1])
                continue
            chosen = [f"{self.most_steps} edits were made, as many as are allowed"]
            if len(self.steps) <= self.most_steps:
                chosen = choose(self.steps, self.tables, self.target, self.rules, self.effects, self.fixed,
                                trainer=self.trainer)  # fmt: skip
            if not isinstance(chosen, list):
                self._take(*chosen)
                continue
            best = self.nearest()
            if any(verdict.step == best.number for verdict in self.verdicts):
                return self._end(best.number, chosen)
            self.verdict(best)

    def nearest(self) -> Step:
        """The step that is nearest to the requirement; of those that meet it, one that was not judged yet."""
        judged = {verdict.step for verdict in self.verdicts}

        def order(step: Step) -> tuple[float, bool, float, int]:
            far, left = self.requirement.distance(step.measured), sum(self.target.parts(step.measured).values())
            return far, step.number in judged, left, step.number

        return min((step for step in self.steps if not step.diverged), key=order)

    def _is_ready(self, step: Step) -> bool:
        """Whether a step meets the requirement on all tuning starts, and was not judged too often."""
        judged = sum(verdict.step == step.number for verdict in self.verdicts)
        return not step.diverged and judged < MOST_VERDICTS and not self.target.misses(step.measured)

    def _starts(self) -> list[tuple[int, int]]:
        """Seed and number of every set of tuning starts: those of a verdict that disappointed have become some."""
        return [
            (TUNING_SEED, TUNING_TRIALS),
            *((verdict.seed, FRESH_TRIALS) for verdict in self.verdicts if verdict.misses),
        ]

    def _measure(self, policy: Policy, task: Task) -> Measured:
        judgements = [
            fly_for(self.requirement, policy, task, *initial_conditions) for initial_conditions in self._starts()
        ]
        return self.requirement.measure(*judgements, fixed=self.bounds)

    def _look_again(self) -> None:
        """Every step measured on all the tuning starts there are."""
        initial_conditions = self._starts()
        for index, step in enumerate(self.steps):
            if step.looks == len(initial_conditions) or step.diverged:
                continue
            policy = load_policy(self._folder(step.number) / "policy.safetensors")
            measured = self._measure(policy, self.task_of(step.number, step.values, step.reasons))
            self.steps[index] = dataclasses.replace(step, measured=measured, looks=len(initial_conditions))
            if step.number == self.verdicts[-1].step:
                trials = sum(number for _, number in initial_conditions)
                said = describe_step(self.steps[index], None, self.target, bounds=bool(self.bounds))
                self.tell(f"again    step {step.number} on all {trials} starts seen so far, tuning starts now: {said}")
        self._write()

    def begin(self) -> None:
        """The first step: the policy of the nearest known task as it flies, or a training of it."""
        start = self.start
        if start.files is None or start.judgement is None:
            self.tell(f"start    {start.name}: nothing that flies this task is known; it is trained from nothing")
            self.train(0, {}, {}, None, None)
            return
        never = f"not within {self.duration:g} s"
        times = ", ".join(
            f"{name} {f'{time:.2f} s' if math.isfinite(time) else never}" for name, time in start.times.items()
        )
        nearest = f"; {start.name} is nearest, as a ratio" if len(start.times) > 1 else ""
        self.tell(f"start    known tasks, as their policies settle: {times}{nearest}")
        folder = self._folder(0)
        folder.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(start.files[0], folder / "policy.safetensors")
        shutil.copyfile(start.files[1], folder / "run.json")
        write_text(folder / "task.toml", write_task(start.task))
        measured = self.requirement.measure(start.judgement, fixed=self.bounds)
        self._keep(
            Step(number=0, values={}, reasons={}, edit=None, origin=None, measured=measured, looks=1, seconds=0.0)
        )

    def _take(self, origin: Step, edit: Edit) -> None:
        number = len(self.steps)
        back = "" if origin is self.steps[-1] else "back "
        self.tell(f"edit {number:<3} {back}on step {origin.number}, {describe_edit(edit, self.target)}")
        so_far = origin.reasons.get(edit.field, f"tuned: {edit.before:g}").split(",")[0]
        why = f"{so_far} -> {edit.after:g}, {edit.condition}: {edit.says} ({edit.rule}, {edit.source})"
        values, reasons = {**origin.values, edit.field: edit.after}, {**origin.reasons, edit.field: why}
        self.train(number, values, reasons, edit, origin.number)

    def train(
        self, number: int, values: dict[str, float], reasons: dict[str, str], edit: Edit | None, origin: int | None
    ) -> None:
        """One more step: the start's task with these values, trained on from step `origin`, and flown."""
        task = self.task_of(number, values, reasons)
        initial = None
        if find_trainer(self.trainer).supports_warm_start and origin is not None:
            initial = load_policy(self._folder(origin) / "policy.safetensors")
        diverged, seconds = "", 0.0
        try:
            policy, seconds = self.learn(task, initial, self._folder(number))
            measured = self._measure(policy, task)
        except Diverged as error:
            if origin is None:
                raise
            diverged, measured = str(error), LOST
        self._keep(
            Step(
                number=number, values=values, reasons=reasons, edit=edit, origin=origin, measured=measured,
                looks=len(self._starts()), seconds=seconds, diverged=diverged,
            )
        )  # fmt: skip

    def learn(self, task: Task, initial: Policy | None, folder: Path) -> tuple[Policy, float]:
        """The policy of a task, trained into `folder` or gone on with there, and the seconds it took."""
        resumable = has_checkpoint(folder)
        if resumable:  # of another version of flytune, perhaps, which chose another edit
            resumable = first_difference(document.plain(load_task(folder / "task.toml")), document.plain(task)) is None
        if folder.exists() and not resumable:
            shutil.rmtree(folder)
        run = train(
            task, self.trainer, seed=self.seed, out=folder, resume=resumable, warm_start=initial,
            on_progress=self.on_progress,
        )  # fmt: skip
        return run.policy, run.metrics[-1]["seconds"]

    def task_of(self, number: int, values: Mapping[str, float], reasons: Mapping[str, str]) -> Task:
        """The task of step `number`: the start's with these edits."""
        if number == 0 and self.start.files is None:
            return self.start.first
        changes = {
            path: (round(value) if is_whole(self.tables, path) else value, reasons[path])
            for path, value in values.items()
        }
        return edited(self.start.task, changes)

    def _keep(self, step: Step) -> None:
        self.steps.append(step)
        self._write()
        self._say(step)

    def _say(self, step: Step) -> None:
        before = self.steps[step.origin].measured if step.origin is not None else None
        self.tell(f"step {step.number:<3} {describe_step(step, before, self.target, bounds=bool(self.bounds))}")

    def verdict(self, step: Step) -> Verdict:
        """The step on starts of its own."""
        seed = FRESH_SEED + len(self.verdicts)
        policy = load_policy(self._folder(step.number) / "policy.safetensors")
        task = self.task_of(step.number, step.values, step.reasons)
        judgement = fly_for(self.requirement, policy, task, seed, FRESH_TRIALS)
        measured = self.requirement.measure(judgement, fixed=self.bounds)
        verdict = Verdict(
            step=step.number, seed=seed, judgement=judgement.to_dict(), misses=self.requirement.misses(measured)
        )
        self.verdicts.append(verdict)
        self._write()
        missing = ", ".join(describe_miss(name, size, self.requirement) for name, size in verdict.misses.items())
        said = describe(measured, self.requirement, bounds=bool(self.bounds))
        self.tell(f"fresh    step {step.number} on {FRESH_TRIALS} starts never flown before: {said}; "
                  f"{f'missing: {missing}' if missing else 'met'}")  # fmt: skip
        return verdict

    def _end(self, best: int, blocked: list[str]) -> Tuning:
        """The best policy put where a run directory has it."""
        folder, step = self._folder(best), self.steps[best]
        for name in ("policy.safetensors", "policy-last.safetensors", "metrics.jsonl", "run.json"):
            if (folder / name).exists():
                shutil.copyfile(folder / name, self.out / name)
        write_text(self.out / "task.toml", write_task(self.task_of(step.number, step.values, step.reasons)))
        told = next((v.judgement for v in reversed(self.verdicts) if v.step == best), None)
        if told is not None:
            write_json(self.out / "evaluation.json", told)
        result = Tuning(
            requirement=self.requirement, start=self.start.name, steps=self.steps, verdicts=self.verdicts, best=best,
            blocked=blocked, directory=self.out, bounds=self.bounds,
        )  # fmt: skip
        self._write({"best": best, "met": result.met, "blocked": blocked})
        return result

    def _folder(self, number: int) -> Path:
        return self.out / "steps" / f"{number:02d}"

    def _write(self, ended: dict[str, Any] | None = None) -> None:
        about = {"start": self.start.name, "duration": self.duration, **(ended or {})}
        write_journal(self.out, self.asked, self.steps, self.verdicts, about)

    def resume(self) -> None:
        """Take up the steps that the directory's journal holds.

        Raises:
            BadInput: there is none, it is damaged, or something else was asked.
        """
        self.steps, self.verdicts = read_journal(self.out, self.asked)


def new_tuning_directory(requirement: Requirement, parent: Path = Path("runs")) -> Path:
    """A directory that does not exist yet, named after what is asked, and numbered where the name is taken."""
    base = parent / f"tune-{requirement.settling_time:g}s"
    path, number = base, 2
    while path.exists():
        path, number = base.with_name(f"{base.name}-{number}"), number + 1
    return path


def tune(
    requirement: Requirement,
    rules: Sequence[Rule],
    out: Path,
    *,
    task: str | None = None,
    edits: Mapping[str, Any] | None = None,
    seed: int = 0,
    trainer: str = DEFAULT_TRAINER,
    most_steps: int = MOST_STEPS,
    resume: bool = False,
    tell: Tell = lambda line: None,
    on_progress: Callable[[Progress], None] | None = None,
) -> Tuning:
    """A policy whose measured response is as required, or the nearest to it that the rules could find.

    Args:
        requirement: what is wanted.
        rules: the heuristics that may be used, see `load_rules`.
        out: directory to write; afterwards a run directory of the best policy, with `steps/` and `tune.json` beside it.
        task: where to begin, a preset or a TOML file; the known task that settles nearest where None.
        edits: field path -> value, which the tuning does not touch; bounds among them have to be kept.
        seed: of the trainings.
        trainer: apg, which goes on from the last policy, or ppo, which begins each training anew.
        most_steps: edits at most.
        resume: go on with the tuning in `out`.
        tell: hears one line for each edit and each result.
        on_progress: called after every update of a training.

    Raises:
        BadInput: an argument that cannot be used, or a requirement that physics forbids; nothing was written.
        Diverged: numbers stopped being finite in a training.
        Interrupted: Ctrl-C; what was done is kept.
    """
    find_trainer(trainer, every_task=True)
    if not 1 <= most_steps <= 100:
        raise BadInput(f"steps: {most_steps} is not allowed. Allowed: a whole number, 1 to 100.")
    if not 0 <= seed < 2**32:
        raise BadInput(f"seed: {seed} is not allowed. Allowed: a whole number, 0 to {2**32 - 1}.")
    if os.path.exists(out) and not os.path.isdir(out):
        raise BadInput(f"out: {out} is a file. Give a directory that does not exist yet.")
    if not resume and any(os.path.exists(out / name) for name in ("tune.json", "run.json", "steps")):
        raise BadInput(f"out: {out} already holds a tuning or a run. Give another directory, or --resume.")
    begun = time.monotonic()
    tuner = Tuner(
        requirement, rules, out, task=task, edits=edits or {}, seed=seed, trainer=trainer, most_steps=most_steps,
        tell=tell, on_progress=on_progress,
    )  # fmt: skip
    if resume:
        tuner.resume()
    try:
        result = tuner.run()
    except (Interrupted, KeyboardInterrupt):
        raise Interrupted(
            f"interrupted in step {len(tuner.steps)}; everything so far is kept in {out}. "
            f"Go on with the same command, --out {out} and --resume."
        ) from None
    trained = len([step for step in result.steps if step.seconds])
    tell(f"{'done' if result.met else 'not met'}     step {result.best} after {trained} trainings, "
         f"{time.monotonic() - begun:.0f} s")  # fmt: skip
    return result
