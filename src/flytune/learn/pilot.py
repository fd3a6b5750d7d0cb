"""Pilots by name: what the command line's WHO stands for."""

import dataclasses
import json
import os
from pathlib import Path
from typing import Any

from flytune.control.classical import CLASSICAL, classical_pilot
from flytune.control.controller import Controller
from flytune.control.policy import load_policy
from flytune.errors import BadInput
from flytune.export.onnx_pilot import load_onnx
from flytune.export.sb3_model import load_sb3
from flytune.learn.directory import read_facts, resume_command
from flytune.learn.shipped import shipped_files, shipped_names
from flytune.task.task import Task, load_task, read_task_text

READERS = {".safetensors": load_policy, ".onnx": load_onnx, ".zip": load_sb3}
KINDS = f"a run directory, a policy file ({', '.join(READERS)}), {', '.join(CLASSICAL)}"


@dataclasses.dataclass(frozen=True, kw_only=True)
class Pilot:
    """A controller, the task it flies, and how it was made."""

    name: str
    controller: Controller
    task: Task  # the one asked for, else the one it was trained for, else the baseline
    metrics: list[dict[str, Any]] | None  # its training, one row per update
    about: dict[str, str]  # facts for a reader


def find_pilot(who: str, task: str | Task | None = None) -> Pilot:
    """The pilot that a run directory, a policy file or the name of a classical controller stands for.

    Args:
        who: `runs/baseline-apg-s0`, `policy.safetensors`, `policy.onnx`, a Stable-Baselines3 model `model.zip`,
            `pid`, `geometric` or `lqr` (gains tuned by search; `pid@textbook` for those of the books).
        task: what it is to fly; its own, or the baseline, where None.

    Raises:
        BadInput: there is no such thing, or it cannot be used.
    """
    wanted = load_task(task) if isinstance(task, str) else task
    path = Path(who)
    if os.path.isdir(who):  # unlike Path.is_dir, also where the name is too long to be one
        return _from_run(who, path, wanted)
    if path.suffix in READERS or os.path.isfile(who):
        return _from_file(who, path, wanted)
    name, at, gains = who.partition("@")
    if name in CLASSICAL:
        flown = wanted or load_task("baseline")
        controller = classical_pilot(name, flown, gains if at else "tuned")
        about = {"controller": name, "gains": gains or "tuned"}
        return Pilot(name=who, controller=controller, task=flown, metrics=None, about=about)
    if who in shipped_names():
        return _shipped(who, wanted)
    raise BadInput(f"{who}: no such pilot. Allowed: {KINDS}{''.join(f', {name}' for name in shipped_names())}.")


def _from_file(who: str, path: Path, wanted: Task | None) -> Pilot:
    policy = READERS.get(path.suffix, load_policy)(path)
    about = {key: str(value) for key, value in policy.about.items() if key != "task_toml"}
    text = policy.about.get("task_toml")
    task = wanted or (read_task_text(text, who) if text else load_task("baseline"))
    return Pilot(name=who, controller=policy, task=task, metrics=None, about=about)


def _shipped(who: str, wanted: Task | None) -> Pilot:
    path, record = shipped_files(who)
    facts = json.loads(record.read_text(encoding="utf-8"))
    pilot = _from_file(who, path, wanted)
    return dataclasses.replace(pilot, about=pilot.about | {"trained": facts["time"], "commit": str(facts["commit"])})


def _from_run(who: str, path: Path, wanted: Task | None) -> Pilot:
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
    task = wanted or load_task(path / "task.toml")
    return Pilot(name=who, controller=policy, task=task, metrics=metrics, about=about)


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
