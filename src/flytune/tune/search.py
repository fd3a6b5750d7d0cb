"""The closed loop: fly, see what is missing, edit the task by a rule, train on from the last policy, and fly again."""

import dataclasses
import json
import math
import shutil
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from flytune import document
from flytune.control.policy import Policy, load_policy
from flytune.errors import BadInput, Interrupted
from flytune.learn.directory import write_text
from flytune.learn.run import Progress, train
from flytune.learn.shipped import shipped_files, shipped_names
from flytune.response.fly import fly
from flytune.response.judge import Judgement, judge
from flytune.task.task import Task, load_task, preset_names, write_task
from flytune.tune.choose import Edit, Step, choose
from flytune.tune.effects import load_effects
from flytune.tune.limits import check_possible
from flytune.tune.requirement import MARGIN, Requirement
from flytune.tune.result import Tuning, Verdict
from flytune.tune.rules import Rule
from flytune.tune.words import describe, describe_edit, describe_step

TUNING_SEED, TUNING_TRIALS = 3000, 100  # the starts that are looked at again and again
FRESH_SEED, FRESH_TRIALS = 4000, 200  # the starts of a verdict; each verdict has its own
MOST_STEPS = 12
STARTS = ("acrobatic-refined", "baseline-refined", "inspection-refined")  # known tasks, fastest first

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
        self.duration = math.ceil(max(10.0, 2.5 * requirement.settling_time))
        self.effects = load_effects()
        self.steps: list[Step] = []
        self.verdicts: list[Verdict] = []
        self.start, self.base, self.policy = self._nearest(task)
        self.tables = document.plain(self.base)
        self.bounds = tuple(path.split(".")[1] for path in self.fixed if path.startswith("termination."))

    # what the loop begins with

    def _nearest(self, wanted: str | None) -> tuple[str, Task, Policy | None]:
        """The known task, with the user's edits, whose policy settles nearest to what is asked; and that policy."""
        names = [wanted] if wanted else list(STARTS)
        found: list[tuple[float, str, Task, Policy | None]] = []
        for name in names:
            task = load_task(name, self.edits)
            policy = _shipped(name) if self.trainer == "apg" else None
            if not found:
                first = fly(policy or _nobody(), task, trials=TUNING_TRIALS, seed=TUNING_SEED, duration=0.6)
                check_possible(task, self.requirement, first, self.fixed)
            if policy is None:
                found.append((math.inf, name, task, None))
                continue
            measured = self.requirement.measure(self._fly(policy, task, TUNING_SEED, TUNING_TRIALS))
            usable = measured.settled >= 0.5 and math.isfinite(measured.settling_time)
            away = abs(math.log(measured.settling_time / self.requirement.aim())) if usable else math.inf
            found.append((away, name, task, policy if usable else None))
        away, name, task, policy = min(found, key=lambda each: each[0])
        if wanted is None and policy is None:
            name = "baseline-refined"
            task = load_task(name, self.edits)
        named = dataclasses.replace(task, name=f"{task.name}-tuned-{self.requirement.settling_time:g}s")
        return name, self._prepared(named, policy), policy

    def _prepared(self, task: Task, policy: Policy | None) -> Task:
        """The task with episodes as long as the response asked for, and a trainer that goes on from a policy."""
        slow = self.requirement.settling_time >= 4
        wanted: dict[str, tuple[Any, str]] = {
            "horizon": (max(task.horizon, round(150 * self.requirement.settling_time)),
                        "tuned: the episodes are longer than the response that is asked for"),
            "duration": (float(self.duration), "tuned: trials of more than twice the settling time asked for"),
        }  # fmt: skip
        if self.trainer == "apg":
            wanted["apg.leeway"] = (max(0.5, float(task.apg.leeway)), "tuned: as the refined presets")
            if slow:
                wanted["apg.window"] = (max(500, task.apg.window), "tuned: a slow response is seen whole")
            if policy is not None:
                wanted["apg.updates"] = (200, "tuned: it goes on from a policy that flies")
                wanted["apg.learning_rate"] = (0.002, "tuned: it goes on from a policy that flies")
        return _edited(task, {path: what for path, what in wanted.items() if not self._is_fixed(path)})

    def _is_fixed(self, path: str) -> bool:
        return any(path == fixed or path.startswith(f"{fixed}.") for fixed in self.fixed)

    # the loop

    def run(self) -> Tuning:
        """Steps until the requirement is met on fresh starts, or nothing can help."""
        self.tell(f"asked    {self.requirement}")
        margin, blocked = MARGIN, []
        if not self.steps:
            self._begin()
        else:
            for step in self.steps:
                self._say(step)
        while True:
            best = min(self.steps, key=lambda step: (self.requirement.distance(step.measured), step.number))
            ready = [s for s in self.steps if not self.requirement.misses(s.measured, margin)]
            ready = [s for s in ready if all(verdict.step != s.number for verdict in self.verdicts)]
            if ready:
                verdict = self._verdict(ready[-1])
                if not verdict.misses:
                    return self._end(ready[-1].number, [])
                margin *= 0.6
                continue
            if len(self.steps) > self.most_steps:
                blocked = [f"{self.most_steps} edits were made, as many as are allowed"]
                break
            chosen = choose(self.steps, self.tables, self.requirement, self.rules, self.effects, self.fixed, margin)
            if isinstance(chosen, list):
                blocked = chosen or ["nothing is missing on the tuning starts, yet the fresh ones say otherwise"]
                break
            self._take(*chosen)
        judged = {verdict.step for verdict in self.verdicts}
        if best.number not in judged and not self._verdict(best).misses:
            blocked = []
        return self._end(best.number, blocked)

    def _begin(self) -> None:
        """The first step: the policy of the nearest known task as it flies, or a training of it."""
        if self.policy is None:
            self.tell(f"start    {self.start}: nothing that flies this task is known; it is trained from nothing")
            self._train(0, {}, {}, None, None)
            return
        self.tell(f"start    {self.start}, the known task that settles nearest")
        folder = self._folder(0)
        folder.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(shipped_files(self.start)[0], folder / "policy.safetensors")
        shutil.copyfile(shipped_files(self.start)[1], folder / "run.json")
        write_text(folder / "task.toml", write_task(self.base))
        judgement = self._fly(self.policy, self.base, TUNING_SEED, TUNING_TRIALS)
        measured = self.requirement.measure(judgement, self.bounds)
        self._keep(Step(number=0, values={}, reasons={}, edit=None, origin=None, measured=measured, seconds=0.0))

    def _take(self, origin: Step, edit: Edit) -> None:
        number = len(self.steps)
        self.tell(f"edit {number:<3} {describe_edit(edit)}")
        so_far = origin.reasons.get(edit.field, f"tuned: {edit.before:g}").split(",")[0]
        why = f"{so_far} -> {edit.after:g}, {edit.condition}: {edit.says} ({edit.rule}, {edit.source})"
        self._train(
            number, {**origin.values, edit.field: edit.after}, {**origin.reasons, edit.field: why}, edit, origin.number
        )

    def _train(
        self, number: int, values: dict[str, float], reasons: dict[str, str], edit: Edit | None, origin: int | None
    ) -> None:
        folder = self._folder(number)
        task = self.task_of(values, reasons)
        resumable = (folder / "checkpoint" / "learner.safetensors").exists() and not (folder / "evaluated").exists()
        if folder.exists() and not resumable:
            shutil.rmtree(folder)
        initial = None
        if self.trainer == "apg" and origin is not None:
            initial = load_policy(self._folder(origin) / "policy.safetensors")
        try:
            run = train(
                task, self.trainer, seed=self.seed, out=folder, resume=resumable, initial=initial,
                on_progress=self.on_progress,
            )  # fmt: skip
        except Interrupted as error:
            raise Interrupted(
                f"interrupted in step {number}; everything so far is kept in {self.out}. "
                "Go on with the same command and --resume."
            ) from error
        judgement = self._fly(run.policy, task, TUNING_SEED, TUNING_TRIALS)
        self._keep(
            Step(
                number=number,
                values=values,
                reasons=reasons,
                edit=edit,
                origin=origin,
                measured=self.requirement.measure(judgement, self.bounds),
                seconds=run.metrics[-1]["seconds"],
            )
        )

    def task_of(self, values: Mapping[str, float], reasons: Mapping[str, str]) -> Task:
        """The start's task with these edits."""
        whole = {"apg.updates", "apg.environments", "apg.window", "horizon"}
        return _edited(
            self.base, {path: (round(v) if path in whole else v, reasons[path]) for path, v in values.items()}
        )

    def _keep(self, step: Step) -> None:
        self.steps.append(step)
        self._write()
        self._say(step)

    def _say(self, step: Step) -> None:
        before = self.steps[step.origin].measured if step.origin is not None else None
        self.tell(f"step {step.number:<3} {describe_step(step, before, self.requirement)}")

    def _verdict(self, step: Step) -> Verdict:
        """The step on starts of its own."""
        seed = FRESH_SEED + len(self.verdicts)
        policy = load_policy(self._folder(step.number) / "policy.safetensors")
        judgement = self._fly(policy, self.task_of(step.values, step.reasons), seed, FRESH_TRIALS)
        measured = self.requirement.measure(judgement, self.bounds)
        verdict = Verdict(
            step=step.number, seed=seed, judgement=judgement.to_dict(), misses=self.requirement.misses(measured)
        )
        self.verdicts.append(verdict)
        self._write()
        said = "met" if not verdict.misses else f"missed: {', '.join(verdict.misses)}"
        self.tell(f"fresh    step {step.number} on {FRESH_TRIALS} starts never flown before: {said}; "
                  f"{describe(measured, self.requirement)}")  # fmt: skip
        return verdict

    def _end(self, best: int, blocked: list[str]) -> Tuning:
        """The best policy put where a run directory has it."""
        folder, step = self._folder(best), self.steps[best]
        for name in ("policy.safetensors", "policy-last.safetensors", "metrics.jsonl", "run.json"):
            if (folder / name).exists():
                shutil.copyfile(folder / name, self.out / name)
        write_text(self.out / "task.toml", write_task(self.task_of(step.values, step.reasons)))
        told = next((v.judgement for v in reversed(self.verdicts) if v.step == best), None)
        if told is not None:
            write_text(self.out / "evaluation.json", json.dumps(told, indent=2) + "\n")
        result = Tuning(
            requirement=self.requirement, start=self.start, steps=self.steps, verdicts=self.verdicts, best=best,
            blocked=blocked, directory=self.out,
        )  # fmt: skip
        self._write({"best": best, "met": result.met, "blocked": blocked})
        return result

    def _fly(self, policy: Policy, task: Task, seed: int, trials: int) -> Judgement:
        return judge(fly(policy, task, trials=trials, seed=seed, duration=float(self.duration)))

    def _folder(self, number: int) -> Path:
        return self.out / "steps" / f"{number:02d}"

    # what is written down

    def _write(self, ended: dict[str, Any] | None = None) -> None:
        told = {
            "schema": 1, **self.asked, "start": self.start, "duration": self.duration,
            "steps": [step.to_dict() for step in self.steps],
            "verdicts": [dataclasses.asdict(verdict) for verdict in self.verdicts], **(ended or {}),
        }  # fmt: skip
        self.out.mkdir(parents=True, exist_ok=True)
        write_text(self.out / "tune.json", json.dumps(told, indent=2) + "\n")

    def resume(self) -> None:
        """Take up the steps that `tune.json` holds.

        Raises:
            BadInput: there is none, it is damaged, or something else was asked.
        """
        path = self.out / "tune.json"
        try:
            told = json.loads(path.read_text(encoding="utf-8"))
            steps = [Step.from_dict(each) for each in told["steps"]]
            verdicts = [Verdict(**each) for each in told["verdicts"]]
            asked = {name: told[name] for name in self.asked}
        except OSError:
            raise BadInput(f"resume: {self.out} holds no tuning. Leave out --resume to start one.") from None
        except (ValueError, KeyError, TypeError) as error:
            raise BadInput(f"resume: {path} is damaged ({error}). Tune again into another directory.") from None
        now = json.loads(json.dumps(self.asked))
        if changed := [name for name in now if now[name] != asked[name]]:
            raise BadInput(
                f"resume: {self.out} was asked for another {', '.join(changed)}. Give the same, or another directory."
            )
        self.steps, self.verdicts = steps, verdicts


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
    trainer: str = "apg",
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
    if trainer not in ("apg", "ppo"):
        raise BadInput(f"trainer: {trainer!r} is not allowed. Allowed: apg, ppo.")
    if not 1 <= most_steps <= 100:
        raise BadInput(f"steps: {most_steps} is not allowed. Allowed: a whole number, 1 to 100.")
    if task is not None and task not in preset_names() and not Path(task).is_file():
        load_task(task)  # says what is allowed
    if out.exists() and not out.is_dir():
        raise BadInput(f"out: {out} is a file. Give a directory that does not exist yet.")
    if not resume and any((out / name).exists() for name in ("tune.json", "run.json")):
        raise BadInput(f"out: {out} already holds a tuning or a run. Give another directory, or --resume.")
    begun = time.monotonic()
    tuner = Tuner(
        requirement, rules, out, task=task, edits=edits or {}, seed=seed, trainer=trainer, most_steps=most_steps,
        tell=tell, on_progress=on_progress,
    )  # fmt: skip
    if resume:
        tuner.resume()
    result = tuner.run()
    trained = len([step for step in result.steps if step.seconds])
    tell(f"{'done' if result.met else 'not met'}     step {result.best} after {trained} trainings, "
         f"{time.monotonic() - begun:.0f} s")  # fmt: skip
    return result


def _shipped(name: str) -> Policy | None:
    return load_policy(shipped_files(name)[0]) if name in shipped_names() else None


def _nobody() -> Any:
    """A pilot that does nothing: its flights are for their starts alone."""
    from flytune.control.classical import classical_pilot

    return classical_pilot("lqr", load_task("baseline"), "tuned")


def _edited(task: Task, changes: Mapping[str, tuple[Any, str]]) -> Task:
    """The task with fields changed, each with the reason as its source."""
    tables = document.plain(task)
    for path, (value, why) in changes.items():
        tables = document.edit(tables, path, value)
        tables["sources"] = {**tables.get("sources", {}), path: why}
    return document.read(Task, tables)
