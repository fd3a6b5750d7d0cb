"""Where a tuning begins: the known task whose policy settles nearest to what is asked."""

import dataclasses
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from flytune.config import document
from flytune.control.classical import classical_controller
from flytune.control.policy import Policy, load_policy
from flytune.errors import BadInput
from flytune.evaluation.fly import fly
from flytune.evaluation.judge import Judgement, judge
from flytune.runs.shipped import shipped_files, shipped_name, shipped_names
from flytune.task.task import Task, load_task
from flytune.training.trainer import find_trainer
from flytune.tuning.feasibility import check_possible
from flytune.tuning.requirement import Requirement
from flytune.tuning.rules import is_fixed

TUNING_SEED, TUNING_TRIALS = 3000, 100  # the starts that are looked at again and again
KNOWN = ("acrobatic-refined", "baseline-refined", "inspection-refined")  # fastest first
WHERE_NOTHING_FLIES = "baseline-refined"
SLOW = 4.0  # s, from which on a training looks 5 s ahead


@dataclasses.dataclass(frozen=True, kw_only=True)
class Start:
    """The task a tuning begins with, and the policy that flies it."""

    name: str
    task: Task  # with the user's fields, prepared for trainings that go on from a policy
    first: Task  # the same, prepared for a training from nothing
    files: tuple[Path, Path] | None  # of the policy, and run.json of its training; None where it has to be learned
    judgement: Judgement | None  # of the policy on the tuning starts
    times: Mapping[str, float]  # known task -> settling time in s of its policy under the user's fields


def tuning_duration(requirement: Requirement) -> float:
    """How long a trial is, in s: 2.5 times the settling time that is asked for, 10 s at least."""
    return float(math.ceil(max(10.0, 2.5 * requirement.settling_time)))


def find_start(requirement: Requirement, wanted: str | None, edits: Mapping[str, Any], trainer: str) -> Start:
    """Where to begin.

    Args:
        requirement: what is wanted.
        wanted: a preset or a TOML file to begin with; the known task that settles nearest where None.
        edits: field path -> value, set by the user.
        trainer: apg or ppo, whose policies are looked at.

    Raises:
        BadInput: no such task, a bad edit, or a requirement that physics forbids.
    """
    tasks = {wanted: load_task(wanted, dict(edits))} if wanted else _known_tasks(edits)
    first = next(iter(tasks.values()))
    nobody = classical_controller("lqr", load_task("baseline"), "tuned")  # its flights are for their starts alone
    flights = fly(nobody, first, trials=TUNING_TRIALS, seed=TUNING_SEED, duration=0.6)
    check_possible(first, requirement, flights, tuple(edits))
    files = {name: found for name, task in tasks.items() if (found := _shipped(name, task, trainer)) is not None}
    policies = {name: load_policy(found[0]) for name, found in files.items()}
    flown = {
        name: fly_for(requirement, policy, tasks[name], TUNING_SEED, TUNING_TRIALS) for name, policy in policies.items()
    }
    measured = {name: requirement.measure(judgement) for name, judgement in flown.items()}
    times = {name: each.settling_time if each.settled >= 0.5 else math.inf for name, each in measured.items()}
    near = {name: abs(math.log(max(time, 1e-3) / requirement.aim())) for name, time in times.items()}
    usable = [name for name in near if math.isfinite(near[name])]
    otherwise = WHERE_NOTHING_FLIES if WHERE_NOTHING_FLIES in tasks else next(iter(tasks))
    name = min(usable, key=near.__getitem__) if usable else otherwise
    task = dataclasses.replace(tasks[name], name=f"{tasks[name].name}-tuned-{requirement.settling_time:g}s")
    return Start(
        name=name,
        task=_prepared(task, requirement, trainer, True, tuple(edits)),
        first=_prepared(task, requirement, trainer, False, tuple(edits)),
        files=files[name] if usable else None,
        judgement=flown[name] if usable else None,
        times=times,
    )


def fly_for(requirement: Requirement, policy: Policy, task: Task, seed: int, trials: int) -> Judgement:
    """A policy judged on trials long enough for what is wanted."""
    return judge(fly(policy, task, trials=trials, seed=seed, duration=tuning_duration(requirement)))


def edited(task: Task, changes: Mapping[str, tuple[Any, str]]) -> Task:
    """The task with fields changed, each with the reason as its source."""
    tables = document.plain(task)
    for path, (value, why) in changes.items():
        tables = document.edit(tables, path, value)
        tables["sources"] = {**tables.get("sources", {}), path: why}
    return document.read(Task, tables)


def _prepared(task: Task, requirement: Requirement, trainer: str, goes_on: bool, fixed: tuple[str, ...]) -> Task:
    """The task with episodes as long as the response asked for, and a trainer that goes on from a policy or not.

    Episodes are made longer by doubling, so that trainings for requirements nearly alike are the same trainings.
    """
    horizon = task.horizon
    while horizon < 150 * requirement.settling_time:
        horizon *= 2
    wanted: dict[str, tuple[Any, str]] = {
        "duration": (tuning_duration(requirement), "tuned: trials of more than twice the settling time asked for")
    }
    if horizon > task.horizon:
        wanted["horizon"] = (horizon, "tuned: the episodes are longer than the response that is asked for")
    learner = find_trainer(trainer)
    settings = learner.settings(task).tuned(slow=requirement.settling_time >= SLOW, warm_start=goes_on)
    wanted |= {f"{learner.settings_field}.{name}": change for name, change in settings.items()}
    return edited(task, {path: what for path, what in wanted.items() if not is_fixed(path, fixed)})


def _known_tasks(edits: Mapping[str, Any]) -> dict[str, Task]:
    """The known tasks that have the fields the user has set."""
    found: dict[str, Task] = {}
    refused: list[BadInput] = []
    for name in KNOWN:
        try:
            found[name] = load_task(name, dict(edits))
        except BadInput as error:
            refused.append(error)
    if not found:
        raise refused[0]
    return found


def _shipped(name: str, task: Task, trainer: str) -> tuple[Path, Path] | None:
    """The policy that ships for a known task, unless the user wants layers it does not have."""
    if name not in KNOWN:
        return None
    learner, known = find_trainer(trainer), shipped_name(name, trainer)
    if learner.supports_warm_start and learner.settings(task).hidden != learner.settings(load_task(name)).hidden:
        return None
    return shipped_files(known) if known in shipped_names() else None
