"""Pilots by name: what the command line's WHO stands for."""

import dataclasses
import json
import os
from pathlib import Path
from typing import Any

from flytune.control.controller import Controller
from flytune.control.policy import load_policy
from flytune.errors import BadInput
from flytune.learn.directory import read_facts, resume_command
from flytune.task.task import Task, load_task, read_task_text


@dataclasses.dataclass(frozen=True, kw_only=True)
class Pilot:
    """A controller, what it was made for, and how it was made."""

    name: str
    controller: Controller
    task: Task | None  # what it was trained for, where that is known
    metrics: list[dict[str, Any]] | None  # its training, one row per update
    about: dict[str, str]  # facts for a reader


def find_pilot(who: str) -> Pilot:
    """The pilot that a run directory or a policy file holds.

    Raises:
        BadInput: there is no such thing, or it cannot be used.
    """
    path = Path(who)
    if os.path.isdir(who):  # unlike Path.is_dir, also where the name is too long to be one
        return _from_run(who, path)
    if path.suffix == ".safetensors" or os.path.isfile(who):
        policy = load_policy(path)
        about = {key: str(value) for key, value in policy.about.items() if key != "task_toml"}
        return Pilot(name=who, controller=policy, task=_task_of(who, policy.about), metrics=None, about=about)
    raise BadInput(
        f"{who}: no such pilot. Allowed: a run directory (as `flytune train` prints it), or a .safetensors policy."
    )


def _from_run(who: str, path: Path) -> Pilot:
    facts = read_facts(path)
    if not (path / "policy.safetensors").exists():
        begun = (path / "checkpoint" / "learner.safetensors").exists()
        remedy = f"Go on with: {resume_command(path, facts['trainer'], facts['seed'])}" if begun else "Train it again."
        raise BadInput(f"{who}: its training has not ended. {remedy}")
    policy = load_policy(path / "policy.safetensors")
    about = {
        "trainer": f"{facts['trainer']}, seed {facts['seed']}",
        "environment steps": str(facts.get("steps", 0)),
        "training time": f"{facts.get('seconds', 0)} s",
        "machine": ", ".join(f"{name} {value}" for name, value in dict(facts["machine"]).items()),
        "versions": ", ".join(f"{name} {version}" for name, version in dict(facts["versions"]).items()),
        "command": " ".join(map(str, facts["command"])),
        "started": facts["time"],
    }
    metrics = _read_metrics(path / "metrics.jsonl")
    return Pilot(name=who, controller=policy, task=load_task(path / "task.toml"), metrics=metrics, about=about)


def _read_metrics(path: Path) -> list[dict[str, Any]] | None:
    if not path.exists():
        return None
    try:
        rows = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
        if not all(isinstance(row, dict) for row in rows):
            raise ValueError("a line is no object")
    except (OSError, ValueError) as error:
        raise BadInput(f"{path}: is damaged ({error}). Remove it to go without the learning curve.") from None
    return rows


def _task_of(who: str, about: dict[str, Any]) -> Task | None:
    text = about.get("task_toml")
    return read_task_text(text, who) if text else None


def task_for(pilot: Pilot, task: str | None) -> Task:
    """The task a pilot is to fly: the one asked for, else its own, else the baseline."""
    if task is not None:
        return load_task(task)
    return pilot.task or load_task("baseline")
