"""Evaluating: controllers are found by name, flown and judged in one call."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from flytune.config import document
from flytune.config.files import make_folder, write_json
from flytune.config.nested import first_difference
from flytune.control.controller import Controller
from flytune.control.schedule import Schedule
from flytune.evaluation.flights import Flights
from flytune.evaluation.fly import fly
from flytune.evaluation.judge import Judgement, judge
from flytune.runs.find import FoundController, find_controller
from flytune.runs.naming import run_name
from flytune.task.files import load_task
from flytune.task.task import Task

EVALUATION = "evaluation.json"


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Evaluation:
    """The flights of one controller, their judgement, and how the controller was trained."""

    name: str
    task: Task
    flights: Flights
    judgement: Judgement
    metrics: list[dict[str, Any]] | None = None  # the training curve, a row per update; None for one without
    about: dict[str, str] = dataclasses.field(default_factory=dict)  # trainer, seed, steps, versions, command line

    def __str__(self) -> str:
        return self.judgement.table()

    def __repr__(self) -> str:
        return f"Evaluation({self.judgement!r})"


def evaluate(
    controller: str | Controller,
    task: str | Path | Task | None = None,
    *,
    name: str = "",
    dial: Schedule | None = None,
    **settings: Any,
) -> Evaluation:
    """The flights and the judgement of one controller over many trials.

    Args:
        controller: what `find_controller` takes (a run directory, a policy file, `pid`, ...), what it returns, or any
            controller.
        task: the task to fly: a preset, a TOML file or a Task; where None, the one the controller was trained for, or
            the baseline for a controller that says none.
        name: the controller's name in tables; where empty, the one it was found by.
        dial: of a policy with dials: dial -> its value, or pairs [[time in s, value], ...] by which it is turned in
            flight; the policy's own setting where None.
        **settings: of `fly`: changes, trials, seed, duration, initial_conditions, simulator, simulator_options.

    Raises:
        BadInput: the controller, the task or a setting cannot be used.
        Diverged: the controller returned an action that is not finite.
    """
    found = _find(controller, task, name, dial)
    flights = fly(found, found.task, name=found.name, **settings)
    return Evaluation(
        name=found.name,
        task=found.task,
        flights=flights,
        judgement=judge(flights),
        metrics=found.metrics,
        about=found.about,
    )


def evaluate_all(
    controllers: Sequence[str | Controller],
    task: str | Path | Task | None = None,
    *,
    dial: Schedule | None = None,
    **settings: Any,
) -> list[Evaluation]:
    """The evaluations of several controllers on one task, see `evaluate`; all are found before the first one flies.

    Where `task` is None, it is that of the first learned policy that says what it was trained for, or the baseline.
    """
    task = shared_task(controllers, task)[0]
    found = [_find(controller, task, dial=dial) for controller in controllers]
    return [evaluate(each, **settings) for each in found]


def shared_task(
    controllers: Sequence[str | Controller], task: str | Path | Task | None = None
) -> tuple[Task, str | None]:
    """The task that several controllers fly, and the name of the controller that it comes from; None where it is given.

    A single controller flies what it would fly alone.

    Raises:
        BadInput: a controller or the task cannot be used.
    """
    if task is not None:
        return load_task(task) if isinstance(task, str | Path) else task, None
    found = [_find(controller, None) for controller in controllers]
    if len(found) == 1:
        return found[0].task, found[0].name
    first = next((each for each in found if each.trained is not None), None)
    return (first.trained, first.name) if first and first.trained else (load_task("baseline"), "")


def _find(
    controller: str | Controller, task: str | Path | Task | None, name: str = "", dial: Schedule | None = None
) -> FoundController:
    wanted = load_task(task) if isinstance(task, str | Path) else task
    found = find_controller(controller, wanted) if isinstance(controller, str) else controller
    if not isinstance(found, FoundController):
        found = FoundController(name=name, controller=found, task=wanted or load_task("baseline"))
    found = dataclasses.replace(found, name=name or found.name, task=wanted or found.task)
    return found.with_dial(dial) if dial else found


def write_evaluation(folder: Path, judgement: Judgement, task: Task | None = None) -> Path:
    """Write `evaluation.json` into a folder, which may be new; returns the file.

    `evaluation.json` of a run directory belongs to the task of the run. Where `task`, which was flown, is another one,
    or the controller met something else, the file is `evaluation-TASK.json`, with a number for what was met.

    Raises:
        BadInput: the file cannot be written.
    """
    make_folder(folder)
    own = folder / "task.toml"
    name = EVALUATION
    if task is not None and own.exists():
        other = first_difference(document.plain(load_task(own)), document.plain(task))
        if other is not None or judgement.changes:
            name = f"{Path(EVALUATION).stem}-{run_name(task.name, judgement.changes)}.json"
    write_json(folder / name, judgement.to_dict())
    return folder / name
