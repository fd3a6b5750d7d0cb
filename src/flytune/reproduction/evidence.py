"""How the policies of a study fly: every policy of every seed, judged under every evaluation setting."""

import dataclasses
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from flytune.control.policy import load_policy
from flytune.evaluation.flights import Flights
from flytune.evaluation.fly import InitialConditions, fly
from flytune.evaluation.judge import Judgement, judge
from flytune.reproduction.study import BEHAVIOURS, Study
from flytune.task.task import Task

Weights = Literal["last", "averaged"]  # of the last update, or their moving average
WEIGHTS_FILES: dict[Weights, str] = {"last": "policy-last.safetensors", "averaged": "policy.safetensors"}
TRIALS, SEED = 100, 1  # of every evaluation (paper R19)
SHOWN = 5  # trials in the paper's performance profile (R21)


@dataclasses.dataclass(frozen=True, kw_only=True)
class EvaluationSetting:
    """From where, how long and with which noise a policy is flown."""

    name: str
    initial_conditions: InitialConditions
    duration: float | None  # s; the task's own where None
    noise: bool = True
    text: str


SETTINGS = (
    EvaluationSetting(name="printed", initial_conditions="paper", duration=10.0, text="as printed: R19 starts, 10 s"),
    EvaluationSetting(
        name="fair", initial_conditions="clear", duration=None, text="fair: z0 >= 0.1 m, the task's own duration"
    ),
    EvaluationSetting(
        name="noiseless",
        initial_conditions="clear",
        duration=None,
        noise=False,
        text="noiseless: fair, without observation noise",
    ),
)


@dataclasses.dataclass(frozen=True, kw_only=True)
class BehaviourResponse:
    """The flights of one behaviour under one setting, judged seed by seed."""

    judgements: list[Judgement]
    flights: Flights  # of the first seed
    rotor_speed: Float[np.ndarray, "seeds N"]  # rpm, mean over motors and time
    progress: Float[np.ndarray, "seeds N"]  # share of the initial horizontal distance that was covered at the end
    distance: Float[np.ndarray, "seeds N"]  # m, horizontal, at the start


@dataclasses.dataclass(frozen=True, kw_only=True)
class Evidence:
    """All that a verdict can rest on."""

    study: Study
    tasks: dict[str, Task]  # by behaviour
    responses: dict[tuple[str, Weights, str], BehaviourResponse]  # by behaviour, weights, name of the setting
    curves: dict[str, list[list[dict[str, Any]]]]  # behaviour -> seed -> rows of metrics.jsonl

    def response(self, behaviour: str, weights: Weights, setting: str = "fair") -> BehaviourResponse:
        """The flights of one behaviour."""
        return self.responses[behaviour, weights, setting]


def gather_evidence(study: Study, on_message: Callable[[str], None] = lambda line: None) -> Evidence:
    """The flights of every policy of a finished study under every setting, and the learning curves.

    The initial state and the noise of a trial are the same for every policy, so that trials can be paired.

    Raises:
        BadInput: a policy is missing or damaged.
        Diverged: a policy returned an action that is not finite.
    """
    tasks = {behaviour: study.task(behaviour) for behaviour in BEHAVIOURS}
    responses, curves = {}, {}
    for behaviour in BEHAVIOURS:
        directories = [training.directory for training in study.trainings() if training.behaviour == behaviour]
        curves[behaviour] = [_read_rows(directory) for directory in directories]
        for weights, file in WEIGHTS_FILES.items():
            paths = [directory / file for directory in directories]
            for setting in SETTINGS:
                responses[behaviour, weights, setting.name] = _fly(paths, tasks[behaviour], setting)
        on_message(f"{study.preset(behaviour)}: evaluated, {TRIALS} trials of each seed under {len(SETTINGS)} settings")
    return Evidence(study=study, tasks=tasks, responses=responses, curves=curves)


def _fly(paths: Sequence[Path], task: Task, setting: EvaluationSetting) -> BehaviourResponse:
    if not setting.noise:
        none = {field.name: 0.0 for field in dataclasses.fields(task.noise)}
        task = dataclasses.replace(task, noise=dataclasses.replace(task.noise, **none))
    judgements, first, speeds, progress, distance = [], None, [], [], []
    for path in paths:
        flights = fly(
            load_policy(path),
            task,
            trials=TRIALS,
            seed=SEED,
            initial_conditions=setting.initial_conditions,
            duration=setting.duration,
            name=f"{path.parent.name}/{path.name}",
        )
        first = first or flights
        judgements.append(judge(flights))
        speeds.append(flights.rotor_speed_rpm[:, 1:].mean(axis=(1, 2)))
        left = np.linalg.norm((flights.position - flights.target_position)[..., :2], axis=-1)
        distance.append(left[:, 0])
        progress.append(1 - left[:, -1] / np.maximum(left[:, 0], 1e-9))
    assert first is not None, "a study has at least one seed"
    return BehaviourResponse(
        judgements=judgements,
        flights=first,
        rotor_speed=np.array(speeds),
        progress=np.array(progress),
        distance=np.array(distance),
    )


def _read_rows(directory: Path) -> list[dict[str, Any]]:
    text = (directory / "metrics.jsonl").read_text(encoding="utf-8")
    return [json.loads(line) for line in text.splitlines()]
