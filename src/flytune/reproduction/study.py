"""A study: the trainings a reproduction is made of, and where each of them stands on disk."""

import dataclasses
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

from flytune.config import document
from flytune.config.files import make_folder, write_json
from flytune.control.policy import load_policy
from flytune.errors import BadInput
from flytune.runs.directory import first_difference, has_checkpoint, read_facts
from flytune.task.task import Task, load_task
from flytune.training.trainer import find_trainer

ROLES = ("baseline", "acrobatic", "inspection")
CONDITION = Literal["new", "begun", "done"]
SCHEMA = 1


@dataclasses.dataclass(frozen=True, kw_only=True)
class Member:
    """One training of a study."""

    role: str  # which of the paper's three behaviours
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
        for role in ROLES:
            self.task(role)

    def preset(self, role: str) -> str:
        """The task that stands for one of the three behaviours."""
        return f"{role}-refined" if self.refined else role

    def task(self, role: str) -> Task:
        """What is trained and flown, with the number of steps the study asks for."""
        task = load_task(self.preset(role))
        return task if self.steps is None else find_trainer(self.trainer).with_steps(task, self.steps)

    def members(self) -> list[Member]:
        """Every training, seed by seed, so that each behaviour has its first policy early."""
        return [
            Member(
                role=role,
                preset=self.preset(role),
                seed=seed,
                directory=self.folder / "runs" / f"{self.preset(role)}-{self.trainer}-s{seed}",
            )
            for seed in range(self.seeds)
            for role in ROLES
        ]

    def plan(self) -> dict[str, Any]:
        """What makes two studies the same one; more seeds only add to it."""
        return {"schema": SCHEMA, "trainer": self.trainer, "steps": self.steps, "refined": self.refined}


def open_study(study: Study) -> None:
    """Make the study's folder, or take up the one that is there.

    Raises:
        BadInput: the folder holds another study or something else, or cannot be written; nothing was changed.
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


def condition(study: Study, member: Member, tell: Callable[[str], None]) -> CONDITION:
    """How far a training is: `new`, `begun` (it goes on from its checkpoint) or `done`.

    A directory that cannot be used is kept under another name, and said so; one that never came to a checkpoint
    holds nothing and is removed.

    Raises:
        BadInput: the directory holds the training of another task.
    """
    here = member.directory
    if not here.exists():
        return "new"
    try:
        facts = read_facts(here)
        task = load_task(here / "task.toml")
        if facts.get("finished"):
            load_policy(here / "policy.safetensors")
            load_policy(here / "policy-last.safetensors")
    except BadInput as error:
        aside = _free_name(here)
        here.rename(aside)
        tell(f"{here.name}: damaged, kept as {aside.name} and trained again ({error})")
        return "new"
    if path := first_difference(document.plain(task), document.plain(study.task(member.role))):
        raise BadInput(
            f"{here}: was trained with another {path} than {member.preset} has now. Give another directory, or move "
            "this one away."
        )
    if facts.get("finished"):
        return "done"
    if has_checkpoint(here):
        return "begun"
    shutil.rmtree(here)
    return "new"


def _free_name(directory: Path) -> Path:
    number = 1
    while (aside := directory.with_name(f"{directory.name}.damaged-{number}")).exists():
        number += 1
    return aside
