"""The call that tunes: from a wanted step response to a policy, with the run directory and the page of the tuning."""

import contextlib
import dataclasses
import os
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from flytune.config.files import RUN_FILES, held, make_folder
from flytune.errors import BadInput, Interrupted
from flytune.report.tuning import write_tuning
from flytune.runs.naming import new_directory, run_name
from flytune.task.files import load_task
from flytune.training.progress import Progress
from flytune.training.trainer import DEFAULT_TRAINER, find_trainer
from flytune.tuning.asked import OVERSHOOT, PERCENTILE, PerAxis, make_requirement
from flytune.tuning.loop import Tuner
from flytune.tuning.messages import line
from flytune.tuning.requirement import Requirement
from flytune.tuning.result import Tuning
from flytune.tuning.rules import Rule, load_rules
from flytune.tuning.start import WITHOUT_POLICY


def tune(
    settling_time: float,
    *,
    overshoot: PerAxis = OVERSHOOT,
    error: PerAxis | None = None,
    axis: str | Sequence[str] = "position",
    percentile: PerAxis = PERCENTILE,
    at_most: bool = False,
    tolerance: float = 10.0,
    task: str | None = None,
    edits: Mapping[str, Any] | None = None,
    rules: str | Path | Sequence[Rule] | None = None,
    trainer: str = DEFAULT_TRAINER,
    seed: int = 0,
    most_iterations: int = 12,
    out: str | Path | None = None,
    resume: bool = False,
    on_message: Callable[[str], None] | None = None,
    on_progress: Callable[[Progress], None] | None = None,
) -> Tuning:
    """The policy whose measured step response meets a requirement, or the nearest one that the rules can find.

    Afterwards the directory is a run directory of the best policy, and holds `report.html`, the journal `tune.json`,
    and one run directory per iteration under `iterations/`.

    Args:
        settling_time: wanted settling time in s.
        overshoot: largest allowed overshoot in percent of the step, median of the trials; or axis -> percent.
        error: largest allowed steady-state error, median of the trials, in m (in deg for yaw), or axis -> error; 0.01 m
            and 1 deg where None.
        axis: whose response: position, x, y, z or yaw; of several, the first settles in the time asked for, and the
            others settle no later.
        percentile: percentile of the trials at which the settling time is taken; or axis -> percentile.
        at_most: whether the settling time is an upper bound instead of a target.
        tolerance: allowed deviation from the settling time in percent.
        task: the task to begin with, a preset or a TOML file; the known task whose policy settles nearest where None.
        edits: field path -> value; the tuning leaves these fields as they are, and keeps a termination bound among
            them as a constraint.
        rules: a TOML file of rules to use beside those of flytune, or the rules to use; those of flytune where None.
        trainer: name of the trainer, one that trains every task; see `flytune tune --help`.
        seed: seed of the trainings.
        most_iterations: largest number of edits.
        out: directory to write; a new one under `runs/` where None.
        resume: whether to continue the tuning in `out`.
        on_message: called with one line for each edit and each result.
        on_progress: called after every update of a training.

    Raises:
        BadInput: an argument cannot be used, or no controller can meet the requirement; nothing was written.
        Diverged: numbers became infinite in the first training.
        Interrupted: Ctrl-C; the results so far are in the directory.
    """
    requirement = make_requirement(
        settling_time, overshoot, error, at_most=at_most, tolerance=tolerance, axis=axis, percentile=percentile
    )
    if rules is None or isinstance(rules, str | Path):
        rules = load_rules(rules)
    method = find_trainer(trainer, every_task=True)
    method.check_edits(edits or {})
    if not 1 <= most_iterations <= 100:
        raise BadInput(f"iterations: {most_iterations} is not allowed. Allowed: a whole number, 1 to 100.")
    if not 0 <= seed < 2**32:
        raise BadInput(f"seed: {seed} is not allowed. Allowed: a whole number, 0 to {2**32 - 1}.")
    changes = dict(edits or {})
    asked = {**dataclasses.asdict(requirement), "task": task, "edits": changes, "trainer": trainer, "seed": seed}
    with _directory(out, requirement, asked, resume) as directory:
        tuner = Tuner(
            requirement=requirement, rules=rules, out=directory, task=task, edits=changes, seed=seed, trainer=trainer,
            most_iterations=most_iterations, on_message=on_message or (lambda _: None), on_progress=on_progress,
        )  # fmt: skip
        method.check(tuner.start.task)  # before anything is written
        if resume:
            tuner.history.read()
        make_folder(directory)
        with held(directory):
            if not resume:
                _check_new(directory)  # again, since another process may have been faster
            return _run(tuner)


def _run(tuner: Tuner) -> Tuning:
    """The result of a tuning, with its page.

    Raises:
        Interrupted: Ctrl-C.
    """
    began, directory = time.monotonic(), tuner.out
    try:
        result = tuner.run()
    except (Interrupted, KeyboardInterrupt):
        raise Interrupted(
            f"interrupted in iteration {len(tuner.history.iterations)}. All results so far are in {directory}. "
            f"To continue, repeat the command with --out {directory} and --resume."
        ) from None
    write_tuning(directory / "report.html", result.to_dict(), tuner.validated.get(result.best))
    trainings = sum(each.seconds > 0 for each in result.iterations)
    outcome = f"requirement {'met' if result.met else 'not met'}; the best policy is that of iteration {result.best}"
    tuner.on_message(line("result", f"{outcome}, after {trainings} trainings and {time.monotonic() - began:.0f} s"))
    return result


def _directory(
    out: str | Path | None, requirement: Requirement, asked: Mapping[str, Any], resume: bool
) -> contextlib.AbstractContextManager[Path]:
    """The directory to write; a new one has a name that differs with what is asked.

    Raises:
        BadInput: it is a file, or it holds a tuning or a run; or there is none to resume.
    """
    if out is None:
        if resume:
            raise BadInput("resume: needs --out DIR, the directory of the tuning to continue.")
        usual = {**vars(make_requirement(requirement.settling_time)), "task": None, "edits": {}}
        usual |= {"trainer": DEFAULT_TRAINER, "seed": 0}
        changes = {name: value for name, value in asked.items() if value != usual[name]}
        return new_directory(run_name(directory_name(requirement, asked["task"], asked["edits"]), changes))
    directory = Path(out)
    # not Path.exists, which raises where a name is too long
    if os.path.exists(directory) and not os.path.isdir(directory):
        raise BadInput(f"out: {directory} is a file. Give a directory that does not exist yet.")
    if not resume:
        _check_new(directory)
    return contextlib.nullcontext(directory)


def directory_name(requirement: Requirement, task: str | None, edits: Mapping[str, Any]) -> str:
    """The name of a tuning: its task and vehicle where they are not the usual ones, and the settling time.

    Raises:
        BadInput: no such task, or a bad edit.
    """
    wanted, usual = load_task(task or WITHOUT_POLICY, dict(edits)), load_task(WITHOUT_POLICY)
    words = [wanted.name] * bool(task) + [wanted.vehicle.name] * (wanted.vehicle.name != usual.vehicle.name)
    return "-".join(["tune", *words, f"{requirement.settling_time:g}s"])


def _check_new(directory: Path) -> None:
    """Refuse a directory that holds a tuning or a run.

    Raises:
        BadInput: it does.
    """
    if any(os.path.exists(directory / name) for name in ("tune.json", "run.json", "iterations")):
        raise BadInput(f"out: {directory} already holds a tuning or a run. Give another directory, or --resume.")
    if taken := [name for name in (*RUN_FILES, "report.html") if os.path.lexists(directory / name)]:
        raise BadInput(
            f"out: {directory} is no tuning and holds {taken[0]}, which is not replaced. Give another directory."
        )
