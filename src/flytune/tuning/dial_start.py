"""A start without training: the policy with a dial that ships, at the setting that is nearest to a requirement."""

import dataclasses
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from flytune.control.policy import Policy, load_policy
from flytune.control.response_map import response_map
from flytune.errors import BadInput
from flytune.evaluation.flights import Flights
from flytune.evaluation.judge import Judgement, judge
from flytune.runs.find import fixed_policy
from flytune.runs.shipped import shipped_files, shipped_name, shipped_names
from flytune.task.files import load_task
from flytune.task.task import Task
from flytune.tuning.flying import flights_for
from flytune.tuning.history import TRAINING_SEED, TRAINING_TRIALS
from flytune.tuning.requirement import Requirement, ResponseSummary, constraints_of

DIAL = "dial"  # the task of the policy
MOST_TURNS = 3  # of the dial, each with a flight of the training set


@dataclasses.dataclass(frozen=True, kw_only=True)
class DialStart:
    """A setting of the dial: the task and the policy that it stands for, both without a dial, and how it flies."""

    setting: dict[str, float]
    task: Task
    family: Task  # the same with its dial
    policy: Policy
    record: Path  # run.json of the training
    flights: Flights  # on the training set
    judgement: Judgement  # of these
    response: ResponseSummary


def find_setting(requirement: Requirement, edits: Mapping[str, Any], trainer: str) -> DialStart | None:
    """The setting of the dial whose response is nearest to a requirement on the training set.

    The first setting is read from the response map that the policy carries. Where its response misses the requirement,
    the dial is turned further by the slope of the map. None where no policy with a dial ships for this trainer, or
    where a field that the user has set follows the dial or does not exist in its task.
    """
    name = shipped_name(DIAL, trainer)
    if name not in shipped_names():
        return None
    try:
        family = load_task(DIAL, dict(edits))
    except BadInput:
        return None
    file, record = shipped_files(name)
    policy = load_policy(file)
    known = response_map(policy)
    if known is None:
        return None
    target, aim, dial = requirement.tightened(), requirement.aim(), family.dial[known.dial]
    value, best = known.setting_for(aim), None
    constraints = constraints_of(family, edits)
    for _ in range(MOST_TURNS):
        value = min(max(float(f"{value:.4g}"), dial.lowest), dial.highest)
        start = _flown(requirement, family, policy.at({known.dial: value}), record, constraints)
        if best is None or target.distance(start.response) < target.distance(best.response):
            best = start
        measured = start.response.settling_time
        if not target.misses(start.response) or not math.isfinite(measured) or measured <= 0:
            break
        further = value * (aim / measured) ** (1 / known.slope())
        if abs(math.log(min(max(further, dial.lowest), dial.highest) / value)) < 0.002:
            break
        value = further
    return best


def _flown(
    requirement: Requirement, family: Task, policy: Policy, record: Path, constraints: tuple[str, ...]
) -> DialStart:
    """The policy at its setting, flown on the training set."""
    fixed, task = fixed_policy(policy, family), family.at(policy.setting)
    flights = flights_for(requirement, fixed, task, TRAINING_SEED, TRAINING_TRIALS)
    judgement = judge(flights)
    return DialStart(
        setting=policy.setting,
        task=task,
        family=family,
        policy=fixed,
        record=record,
        flights=flights,
        judgement=judgement,
        response=requirement.measure(judgement, constraints=constraints),
    )
