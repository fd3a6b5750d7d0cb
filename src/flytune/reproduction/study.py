"""A study: the trainings that a reproduction is made of, and how far each of them is on disk."""

import dataclasses
import itertools
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

from flytune.config import document
from flytune.config.files import make_folder, write_json
from flytune.config.nested import first_difference
from flytune.control.policy import load_policy
from flytune.errors import BadInput
from flytune.runs.directory import has_checkpoint, read_facts
from flytune.task.files import load_task
from flytune.task.task import Task
from flytune.training.trainer import find_trainer

BEHAVIOURS = ("baseline", "acrobatic", "inspection")  # of the paper
TrainingStatus = Literal["new", "interrupted", "finished"]
SCHEMA = 1


@dataclasses.dataclass(frozen=True, kw_only=True)
class Training:
    """One training of a study."""

    behaviour: str
    preset: str
    seed: int
    directory: Path


@dataclasses.dataclass(frozen=True, kw_only=True)
class Study:
    """Three behaviours, some seeds of each, one trainer."""

    folder: Path
    trainer: str = "ppo"
    seeds: int = 5
    steps: int | None = None  # environment steps of each training; the task's own where None
    refined: bool = False  # the refined presets in place of the printed ones

    def __post_init__(self) -> None:
        find_trainer(self.trainer, every_task=True)
        if not 1 <= self.seeds <= 100:
            raise BadInput(f"seeds: {self.seeds} is not allowed. Allowed: a whole number, 1 to 100.")
        for behaviour in BEHAVIOURS:
            self.task(behaviour)

    def preset(self, behaviour: str) -> str:
        """The task that stands for one of the three behaviours."""
        return f"{behaviour}-refined" if self.refined else behaviour

    def task(self, behaviour: str) -> Task:
        """The task that is trained and flown, with the number of steps that the study asks for."""
        task = load_task(self.preset(behaviour))
        return task if self.steps is None else find_trainer(self.trainer).with_steps(task, self.steps)

    def trainings(self) -> list[Training]:
        """Every training, seed by seed, so that each behaviour has its first policy early."""
        return [
            Training(
                behaviour=behaviour,
                preset=self.preset(behaviour),
                seed=seed,
                directory=self.folder / "runs" / f"{self.preset(behaviour)}-{self.trainer}-s{seed}",
            )
            for seed in range(self.seeds)
            for behaviour in BEHAVIOURS
        ]

    def plan(self) -> dict[str, Any]:
        """What two studies must have in common to be the same study; the number of seeds may grow."""
        return {"schema": SCHEMA, "trainer": self.trainer, "steps": self.steps, "refined": self.refined}


def open_study(study: Study) -> None:
    """Make the study's folder, or accept the one that is there.

    Raises:
        BadInput: the folder holds another study or something else, or cannot be written. Nothing was changed.
    """
    path = study.folder / "reproduction.json"
    if study.folder.exists() and not study.folder.is_dir():
        raise BadInput(f"out: {study.folder} is a file. Give a directory.")
    if path.exists():
        try:
            there = json.loads(path.read_text(encoding="utf-8"))
        except (OSError, ValueError):
            raise BadInput(f"out: {path} is damaged. Move {study.folder} away, or give another directory.") from None
        if difference := first_difference(there, study.plan()):
            raise BadInput(
                f"out: {study.folder} holds a reproduction with another {difference} ({there.get(difference)}, not "
                f"{study.plan().get(difference)}). Ask for the same, or give another directory."
            )
        return
    if study.folder.exists() and any(study.folder.iterdir()):
        raise BadInput(f"out: {study.folder} is not empty and holds no reproduction. Give another directory.")
    make_folder(study.folder / "runs")
    write_json(path, study.plan())


def training_status(study: Study, training: Training, on_message: Callable[[str], None]) -> TrainingStatus:
    """How far a training is; an interrupted one has a checkpoint to continue from.

    A directory that cannot be used is kept under another name, and a message says so. A directory without a
    checkpoint holds nothing and is removed.

    Raises:
        BadInput: the directory holds the training of another task.
    """
    directory = training.directory
    if not directory.exists():
        return "new"
    try:
        facts = read_facts(directory)
        task = load_task(directory / "task.toml")
        if facts.get("finished"):
            load_policy(directory / "policy.safetensors")
            load_policy(directory / "policy-last.safetensors")
    except BadInput as error:
        names = (directory.with_name(f"{directory.name}.damaged-{number}") for number in itertools.count(1))
        aside = next(name for name in names if not name.exists())
        directory.rename(aside)
        on_message(f"{directory.name}: damaged, kept as {aside.name} and trained again ({error})")
        return "new"
    if path := first_difference(document.plain(task), document.plain(study.task(training.behaviour))):
        raise BadInput(
            f"{directory}: was trained with another {path} than {training.preset} has now. Give another directory, or "
            "move this one away."
        )
    if facts.get("finished"):
        return "finished"
    if has_checkpoint(directory):
        return "interrupted"
    shutil.rmtree(directory)
    return "new"
