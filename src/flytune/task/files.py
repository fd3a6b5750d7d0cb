"""Tasks as files: presets, TOML files that change one, edits of a single field, and the complete text of a task."""

import dataclasses
import os
from importlib import resources
from pathlib import Path
from typing import Any

from flytune.config import document, nested
from flytune.errors import BadInput
from flytune.physics.vehicle import vehicle_table
from flytune.task.following import check_given, settings_to_check
from flytune.task.task import Task

TASK_FILE = "task.toml"  # in a run directory

# keys of task files that had another name in version 0.1
RENAMED = {
    "apg.average": "apg.ema_decay",
    "apg.gradient_norm": "apg.max_grad_norm",
    "apg.leeway": "apg.termination_slack",
    "apg.momentum": "apg.adam_b1",
    "apg.second_momentum": "apg.adam_b2",
    "ppo.average": "ppo.ema_decay",
    "ppo.clip": "ppo.clip_range",
    "ppo.clip_apart": "ppo.separate_grad_clipping",
    "ppo.gradient_norm": "ppo.max_grad_norm",
}


def preset_names() -> list[str]:
    """The tasks that ship with flytune."""
    folder = resources.files("flytune.task") / "presets"
    return sorted(entry.name.removesuffix(".toml") for entry in folder.iterdir() if entry.name.endswith(".toml"))


def load_task(task: str | Path, edits: dict[str, Any] | None = None) -> Task:
    """A task by preset name or TOML file, with edits applied.

    Args:
        task: a preset (`baseline`, `acrobatic`, `inspection`, or one of them `-refined`), a run directory, or a .toml
            file, which may say `based_on = "PRESET"` and then only what it changes.
        edits: field path -> value, for instance {"reward.velocity.weight": 0.08}; `vehicle` also takes a name.

    Raises:
        BadInput: unknown, unreadable, or not a task; one line that names the field.
    """
    name, given = str(task), {}
    if name not in preset_names() and os.path.isfile(os.path.join(name, TASK_FILE)):
        name = os.path.join(name, TASK_FILE)
    if name in preset_names():
        data, where = _preset(name), ""
    elif name.endswith(".toml") or os.path.isfile(name):
        given = document.load(Path(name))
        data = _on_its_base(_with_sources({"name": Path(name).stem, **given}, name), name)
        where = name
    else:
        hint = document.nearest(name, preset_names())
        raise BadInput(
            f"task: {name!r} is no preset. Allowed: {', '.join(preset_names())}, a .toml file, or a run directory."
            + (f" Did you mean {hint}?" if hint else "")
        )
    task_read = _read(data, where)
    check_given(task_read.follow, document.plain(task_read), given, where)
    if not edits:
        return task_read
    complete = document.plain(task_read)
    for path, value in edits.items():
        complete = _edited(complete, path, value)
    return _read(complete)


def _preset(name: str) -> dict[str, Any]:
    """The tables of a preset."""
    with resources.as_file(resources.files("flytune.task") / "presets" / f"{name}.toml") as path:
        return _on_its_base({"name": name, **document.load(path)}, name)


def _on_its_base(data: dict[str, Any], where: str) -> dict[str, Any]:
    """The tables laid over those of the preset that `based_on` names, so that a file need only say what it changes."""
    if "based_on" not in data:
        return data
    changes = {key: value for key, value in data.items() if key != "based_on"}
    base = data["based_on"]
    if base not in preset_names():
        raise BadInput(f"{where}: based_on: {base!r} is no preset. Allowed: {', '.join(preset_names())}.")
    return nested.overlay(_preset(base), changes)


def _with_sources(data: dict[str, Any], file: str) -> dict[str, Any]:
    """The tables of a file that changes a preset; the source of each changed value without one is the file."""
    sources = data.get("sources", {})
    if "based_on" not in data or not isinstance(sources, dict):  # else it is refused, with its name, when it is read
        return data
    changed = {key: value for key, value in data.items() if key not in ("based_on", "vehicle")}
    paths = (path for path, _ in nested.leaves(changed, skip=nested.LABELS))
    text = f"set in {Path(file).name}"
    return {**data, "sources": {path: text for path in paths if not document.source_of(path, sources)} | sources}


def read_task_text(text: str, where: str) -> Task:
    """A task from its complete TOML text, as `write_task` gives it.

    Raises:
        BadInput: not a task.
    """
    return _read(document.parse(text, where), where)


def write_task(task: Task) -> str:
    """The TOML text of a task: exact, complete, and with unit, range and source beside each number."""
    sources = dict(task.sources) | {f"vehicle.{path}": text for path, text in task.vehicle.sources.items()}
    return document.write(task, sources, heading=f"flytune task {task.name}: value  # unit; allowed; source")


def _read(data: dict[str, Any], where: str = "") -> Task:
    """The task of complete tables, in which `vehicle` may be a name.

    Raises:
        BadInput: not a task, or one with a key that has another name now.
    """
    for old, new in RENAMED.items():
        if nested.look_up(data, old) is not None:
            raise BadInput(f"{f'{where}: ' if where else ''}{old}: is called {new} now. Write {new} instead.")
    vehicle = data.get("vehicle")
    complete = {**data, "vehicle": vehicle_table(vehicle)} if isinstance(vehicle, str) else data
    return _at_default(document.read(Task, complete, where), where)


def _edited(data: dict[str, Any], path: str, value: Any) -> dict[str, Any]:
    """The task's tables after one edit, the source of what was edited now the user."""
    followed = [each for each in data.get("follow", {}) if f"{each}.".startswith(f"{path}.")]
    if followed and (path in followed or isinstance(value, dict)):
        formula = data["follow"][followed[0]]
        raise BadInput(
            f"{followed[0]}: follows the dials of this task, as {formula}. Change the formula, "
            f"follow.{followed[0]}=FORMULA, or the default of a dial, "
            f"{' '.join(f'dial.{name}.default=...' for name in data['dial'])}."
        )
    if path.startswith("follow."):  # the path of a field, which is one key
        formula = str(value) if isinstance(value, int | float) and not isinstance(value, bool) else value
        return {**data, "follow": {**data.get("follow", {}), path.removeprefix("follow."): formula}}
    if path == "vehicle" and isinstance(value, str):
        return {**data, "vehicle": vehicle_table(value)}
    data = nested.edit(data, path, value)
    owner, field = (data["vehicle"], path[len("vehicle.") :]) if path.startswith("vehicle.") else (data, path)
    if not path.startswith(("name", "sources", "vehicle.name", "vehicle.sources")):
        sources = owner.get("sources", {})
        if isinstance(sources, dict):  # else it is refused, with its name, when the task is read
            owner["sources"] = {**sources, field: "set by the user"}
    return data


def _at_default(task: Task, where: str) -> Task:
    """The task, where the fields that follow dials have their values at the default setting; all settings checked.

    Raises:
        BadInput: a field in `follow` does not exist, or has a value that is not allowed at some setting.
    """
    if not task.dial:
        return task
    prefix = f"{where}: " if where else ""
    for setting in settings_to_check(task.dial):
        task.fixed_at(setting, prefix)
    at_default = task.fixed_at({name: dial.default for name, dial in task.dial.items()}, prefix)
    return dataclasses.replace(at_default, dial=task.dial, follow=task.follow, input=task.input)
