"""The start of a tuning: the known task whose policy settles nearest to the requirement."""

import dataclasses
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from flytune.config import document, nested
from flytune.control.policy import Policy, load_policy
from flytune.errors import BadInput
from flytune.evaluation.judge import Judgement
from flytune.runs.shipped import shipped_files, shipped_name, shipped_names
from flytune.task.files import load_task
from flytune.task.task import Task
from flytune.training.trainer import find_trainer
from flytune.tuning.dial_start import DIAL, find_setting
from flytune.tuning.feasibility import check_feasible
from flytune.tuning.flying import fly_for, hover_flights
from flytune.tuning.history import TRAINING_SEED, TRAINING_TRIALS
from flytune.tuning.requirement import Requirement, ResponseSummary, constraints_of
from flytune.tuning.rules import edited, is_fixed

KNOWN = ("acrobatic-refined", "baseline-refined", "inspection-refined")  # fastest first
WITHOUT_POLICY = "baseline-refined"  # the task to begin with where no known policy settles
OF_TRAINING = ("name", "sources", "duration", "horizon", "dial", "follow", "input", "apg", "ppo")  # how it is learned
SLOW = 4.0  # s; for longer settling times the window of a training is 5 s


@dataclasses.dataclass(frozen=True, kw_only=True)
class Start:
    """The task that a tuning begins with, and its policy."""

    name: str
    task: Task  # with the user's fields and the settings for a warm start
    first: Task  # the same, with the settings for a training from new weights
    policy: Policy | None  # None where none is known for this task, which is then trained first
    initial: Policy | None  # the policy whose weights that first training starts from; None: from new weights
    trained_for: str  # a field in which the task of the nearest known policy differs, empty where in none
    record: Path | None  # run.json of the training of the policy
    setting: Mapping[str, float]  # of the dial that the policy was made from; empty without one
    judgement: Judgement | None  # of the policy on the training set
    times: Mapping[str, float]  # known task -> settling time in s of its policy, with the user's fields


def find_start(requirement: Requirement, wanted: str | None, edits: Mapping[str, Any], trainer: str) -> Start:
    """The start of a tuning.

    Args:
        requirement: the requirement.
        wanted: a preset or a TOML file to begin with; the known task whose policy settles nearest where None.
        edits: field path -> value, set by the user.
        trainer: name of the trainer; only policies that it has trained are used.

    Raises:
        BadInput: no such task, a bad edit, or a requirement that no controller can meet.
    """
    kind = load_task(wanted, dict(edits)).target.kind if wanted else _kind(edits)
    if kind != "point":
        raise BadInput(
            f"target.kind: {kind} is not allowed in a tuning, since a target that moves has no settling time. Allowed: "
            "point. Tune the response to a point; the controller then follows paths as well."
        )
    if wanted and load_task(wanted, dict(edits)).dial:
        if wanted != DIAL:
            raise BadInput(
                f"task: {wanted} has a dial. Allowed: a task without one, or {DIAL}. Train it, and set its dial: "
                "flytune evaluate RUN@settling_time=S."
            )
        wanted = None  # its dial is what is set first in any case
    dialled = find_setting(requirement, edits, trainer) if not wanted else None
    tasks: dict[str, Task] = {}
    times: dict[str, float] = {}
    if dialled is not None:
        tasks[DIAL], times[DIAL] = dialled.task, _time(dialled.response)
    if dialled is None or requirement.misses(dialled.response):  # else no other has to be flown
        tasks |= {wanted: load_task(wanted, dict(edits))} if wanted else _known_tasks(edits, needed=dialled is None)
    first = next(iter(tasks.values()))
    flights = dialled.flights if dialled is not None else hover_flights(first, TRAINING_SEED, TRAINING_TRIALS)
    check_feasible(first, requirement, flights, tuple(edits))
    name = WITHOUT_POLICY if WITHOUT_POLICY in tasks else next(iter(tasks))
    policy = record = judgement = None
    smallest = math.inf
    for known, task in tasks.items():
        if known == DIAL and dialled is not None:
            found, judged = (dialled.policy, dialled.record), dialled.judgement
        elif (files := _shipped(known, task, trainer)) is not None:
            found = load_policy(files[0]), files[1]
            judged = fly_for(requirement, found[0], task, TRAINING_SEED, TRAINING_TRIALS)
            times[known] = _time(requirement.measure(judged))
        else:
            continue
        ratio = abs(math.log(max(times[known], 1e-3) / requirement.aim()))
        if ratio < smallest:
            smallest, name, (policy, record), judgement = ratio, known, found, judged
    nearest, other = policy, []
    if edits and name in (DIAL, *KNOWN):
        flown = dialled.family if dialled is not None and name == DIAL else tasks[name]
        other = _other_fields(load_task(name), flown)
        if judgement is not None and other:
            response = requirement.measure(judgement, constraints=constraints_of(tasks[name], edits))
            if requirement.misses(response) or any(field.startswith("reward.") for field in other):
                policy = record = judgement = None
    same_vehicle = not any(field.startswith("vehicle.") for field in other)
    warm = policy is None and same_vehicle and find_trainer(trainer).tuning_goes_on
    task = dataclasses.replace(tasks[name], name=f"{tasks[name].name}-tuned-{requirement.settling_time:g}s")
    return Start(
        name=name,
        task=_prepared(task, requirement, trainer, True, tuple(edits)),
        first=_prepared(task, requirement, trainer, False, tuple(edits)),
        policy=policy,
        initial=nearest if warm else None,
        trained_for=other[0] if policy is None and other else "",
        record=record,
        setting=dialled.setting if dialled is not None and name == DIAL else {},
        judgement=judgement,
        times=times,
    )


def _other_fields(trained: Task, wanted: Task) -> list[str]:
    """In which fields two tasks differ, of those that are flown or rewarded: the first one of each part, vehicle first.

    Fields that follow a dial are left out: the dial sets them.
    """
    one, other = document.plain(trained), document.plain(wanted)
    for path in trained.follow:
        other = nested.edit(other, path, nested.look_up(one, path))
    parts = ["vehicle", *(key for key in one if key not in (*OF_TRAINING, "vehicle"))]
    differences = (nested.first_difference({part: one[part]}, {part: other[part]}) for part in parts)
    return [path for path in differences if path]


def _kind(edits: Mapping[str, Any]) -> str:
    """The kind of target that the edits of a known task give it."""
    table = edits.get("target")
    return edits.get("target.kind", table.get("kind", "point") if isinstance(table, Mapping) else "point")


def _time(response: ResponseSummary) -> float:
    """The settling time in s, infinite where fewer than half of the trials settle."""
    return response.settling_time if response.settled >= 0.5 else math.inf


def _prepared(task: Task, requirement: Requirement, trainer: str, warm_start: bool, fixed: tuple[str, ...]) -> Task:
    """The task with episodes as long as the wanted response, and settings for a training with or without a warm start.

    The episodes are lengthened by doubling, so that similar requirements lead to the same trainings.
    """
    horizon = task.horizon
    while horizon < 150 * requirement.settling_time:
        horizon *= 2
    wanted: dict[str, tuple[Any, str]] = {
        "duration": (requirement.trial_duration(), "tuned: trials last more than twice the wanted settling time")
    }
    if horizon > task.horizon:
        wanted["horizon"] = (horizon, "tuned: the episodes last longer than the wanted response")
    method = find_trainer(trainer)
    settings = method.settings(task).tuned(slow=requirement.settling_time >= SLOW, warm_start=warm_start)
    wanted |= {f"{method.settings_field}.{name}": change for name, change in settings.items()}
    free = {path: change for path, change in wanted.items() if not is_fixed(path, fixed)}
    values = {path: value for path, (value, _) in free.items()}
    return edited(document.plain(task), values, {path: reason for path, (_, reason) in free.items()})


def _known_tasks(edits: Mapping[str, Any], *, needed: bool) -> dict[str, Task]:
    """The known tasks that have all fields the user has set; where one is needed, there is at least one."""
    found: dict[str, Task] = {}
    refused: list[BadInput] = []
    for name in KNOWN:
        try:
            found[name] = load_task(name, dict(edits))
        except BadInput as error:
            refused.append(error)
    if needed and not found:
        raise refused[0]
    return found


def _shipped(name: str, task: Task, trainer: str) -> tuple[Path, Path] | None:
    """The policy that ships for a known task, unless the user has set other hidden layers."""
    if name not in KNOWN:
        return None
    method, known = find_trainer(trainer), shipped_name(name, trainer)
    if method.tuning_goes_on and method.settings(task).hidden != method.settings(load_task(name)).hidden:
        return None
    return shipped_files(known) if known in shipped_names() else None
