"""What the policies of a study fly like: every policy, seed and condition, judged."""

import dataclasses
import json
from collections.abc import Callable, Sequence
from typing import Any, Literal

import numpy as np

from flytune.control.policy import load_policy
from flytune.evaluation.flights import Flights
from flytune.evaluation.fly import InitialConditions, fly
from flytune.evaluation.judge import Judgement, judge
from flytune.reproduction.study import ROLES, Study
from flytune.task.task import Task

Flown = Literal["last", "average"]
FLOWN: dict[Flown, str] = {"last": "policy-last.safetensors", "average": "policy.safetensors"}
TRIALS, SEED = 100, 1  # of every evaluation (paper R19)
SHOWN = 5  # trials in the paper's performance profile (R21)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Condition:
    """Under which circumstances a policy is flown."""

    name: str
    initial_conditions: InitialConditions
    duration: float | None  # s; the task's own where None
    noise: bool = True
    text: str


CONDITIONS = (
    Condition(name="printed", initial_conditions="paper", duration=10.0, text="as printed: R19 starts, 10 s"),
    Condition(
        name="fair",
        initial_conditions="clear",
        duration=None,
        text="fair: z0 >= 0.1 m, as long as the speed bound asks for",
    ),
    Condition(
        name="quiet", initial_conditions="clear", duration=None, noise=False, text="fair, without observation noise"
    ),
)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Seat:
    """What one behaviour flew like under one condition, seed by seed."""

    judgements: list[Judgement]
    flights: Flights  # of the first seed
    rotor_speed: np.ndarray  # [seeds, N] rpm, mean over motors and time
    progress: np.ndarray  # [seeds, N] share of the starting horizontal distance that was covered at the end
    distance: np.ndarray  # [seeds, N] m, horizontal, at the start


@dataclasses.dataclass(frozen=True, kw_only=True)
class Evidence:
    """All that a verdict can rest on."""

    study: Study
    tasks: dict[str, Task]  # by role
    seats: dict[tuple[str, Flown, str], Seat]  # by role, policy, condition
    curves: dict[str, list[list[dict[str, Any]]]]  # role -> seed -> rows of metrics.jsonl

    def seat(self, role: str, flown: Flown, condition: str = "fair") -> Seat:
        """What one behaviour flew like."""
        return self.seats[role, flown, condition]


def gather(study: Study, tell: Callable[[str], None] = lambda line: None) -> Evidence:
    """Fly every policy of a finished study under every condition.

    Start and noise of a trial are the same for every policy, so that trials can be paired.

    Raises:
        BadInput: a policy is missing or damaged.
        Diverged: a policy answered with an action that is not finite.
    """
    tasks = {role: study.task(role) for role in ROLES}
    seats = {}
    for role in ROLES:
        for flown, file in FLOWN.items():
            for condition in CONDITIONS:
                paths = [member.directory / file for member in study.members() if member.role == role]
                seats[role, flown, condition.name] = _fly(paths, tasks[role], condition)
        tell(f"{study.preset(role)}: flown, {TRIALS} trials a seed under {len(CONDITIONS)} conditions")
    curves = {
        role: [_read_rows(member.directory) for member in study.members() if member.role == role] for role in ROLES
    }
    return Evidence(study=study, tasks=tasks, seats=seats, curves=curves)


def _fly(paths: Sequence[Any], task: Task, condition: Condition) -> Seat:
    silence = {field.name: 0.0 for field in dataclasses.fields(task.noise)}
    flown = task if condition.noise else dataclasses.replace(task, noise=dataclasses.replace(task.noise, **silence))
    judgements, first, speeds, progress, distance = [], None, [], [], []
    for path in paths:
        flights = fly(
            load_policy(path),
            flown,
            trials=TRIALS,
            seed=SEED,
            initial_conditions=condition.initial_conditions,
            duration=condition.duration,
            name=f"{path.parent.name}/{path.name}",
        )
        first = first or flights
        judgements.append(judge(flights))
        speeds.append(flights.rotor_speed_rpm[:, 1:].mean(axis=(1, 2)))
        way = np.linalg.norm((flights.position - flights.target_position)[..., :2], axis=-1)
        distance.append(way[:, 0])
        progress.append(1 - way[:, -1] / np.maximum(way[:, 0], 1e-9))
    assert first is not None, "a study has at least one seed"
    return Seat(
        judgements=judgements,
        flights=first,
        rotor_speed=np.array(speeds),
        progress=np.array(progress),
        distance=np.array(distance),
    )


def _read_rows(directory: Any) -> list[dict[str, Any]]:
    text = (directory / "metrics.jsonl").read_text(encoding="utf-8")
    return [json.loads(line) for line in text.splitlines()]
