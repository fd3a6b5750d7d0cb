"""Tasks as files: presets, TOML files that change one, edits of a single field, and the complete text of a task."""

import dataclasses
import os
from collections.abc import Mapping
from importlib import resources
from pathlib import Path
from typing import Any, TypeGuard

from flytune.config import document, nested
from flytune.config.fields import annotations, is_named
from flytune.config.recognise import TASK, VEHICLE, meant, misplaced, runs_in
from flytune.config.removal import NONE, without_none
from flytune.errors import BadInput
from flytune.physics.plausibility import summary
from flytune.physics.vehicle import Vehicle, vehicle_names, vehicle_table
from flytune.task.following import check_given, settings_to_check
from flytune.task.target import of_kind
from flytune.task.task import Task
from flytune.task.waypoints import read_target

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
NAMED = tuple(name for name, kind in annotations(Task).items() if is_named(kind) and name != "sources")


def preset_names() -> list[str]:
    """The tasks that ship with flytune."""
    folder = resources.files("flytune.task") / "presets"
    return sorted(entry.name.removesuffix(".toml") for entry in folder.iterdir() if entry.name.endswith(".toml"))


def load_task(task: str | Path, edits: dict[str, Any] | None = None) -> Task:
    """A task by preset name or TOML file, with edits applied.

    Args:
        task: a preset (`baseline`, `acrobatic`, `inspection`, or one of them `-refined`), a run directory, or a .toml
            file, which may say `based_on = "PRESET"`, or the path of another file, and then only what it changes. Paths
            in a file are relative to its folder.
        edits: field path -> value, for instance {"reward.velocity.weight": 0.08}; `vehicle` also takes a name or a
            file. The value "none" removes a reward term, a termination, a dial, a formula, an input or an optional
            field.

    Raises:
        BadInput: unknown, unreadable, or not a task; one line that names the field.
    """
    name, given = str(task), {}
    if name not in preset_names() and os.path.isfile(os.path.join(name, TASK_FILE)):
        name = os.path.join(name, TASK_FILE)
    elif line := misplaced(name, TASK):
        raise BadInput(f"task: {line}")
    if name in preset_names():
        data, where = _preset(name), ""
    elif name.endswith(".toml") and not os.path.exists(name) and (hint := meant(name, TASK, [], [".toml"])):
        raise BadInput(f"task: {name}: no such file.{hint}")
    elif name.endswith(".toml") or os.path.isfile(name):
        data, given = _from_file(Path(name))
        where = name
    else:
        hint = meant(name, TASK, preset_names(), [".toml"]) or runs_in(name)
        raise BadInput(
            f"task: {name!r} is no preset. Allowed: {', '.join(preset_names())}, a .toml file, or a run directory."
            f"{hint}"
        )
    task_read = _read(data, where)
    check_given(task_read.follow, document.plain(task_read), given, where)
    if not edits:
        return task_read
    return edited_task(task_read, edits)


def edited_task(task: Task, edits: Mapping[str, Any]) -> Task:
    """A task with edits applied, as in `load_task`.

    Raises:
        BadInput: a field or a value that is not allowed.
    """
    complete = document.plain(task)
    for path, value in sorted(edits.items(), key=lambda edit: edit[0].count(".")):  # a table before what is in it
        complete = _edited(complete, path, value)
    return _read(complete)


def _preset(name: str) -> dict[str, Any]:
    """The tables of a preset."""
    with resources.as_file(resources.files("flytune.task") / "presets" / f"{name}.toml") as path:
        data = {"name": name, **document.load(path)}
    return _laid_over(_preset(data["based_on"]), data, name) if "based_on" in data else data


def _from_file(path: Path, above: tuple[Path, ...] = ()) -> tuple[dict[str, Any], dict[str, Any]]:
    """The tables of a task file, laid over those of what it is based on; and what the files themselves say.

    Paths in a file are relative to its folder.

    Args:
        path: the file.
        above: the files that are based on it.

    Raises:
        BadInput: it cannot be read, is based on nothing that exists, or in the end on itself.
    """
    if (resolved := path.resolve()) in above:
        raise BadInput(f"{above[0]}: based_on: leads back to {path}. Base one of these files on a preset.")
    given = document.load(path)
    data = _with_sources({"name": path.stem, **given}, str(path))
    named = isinstance(vehicle := data.get("vehicle"), str)
    if isinstance(vehicle, str):
        data["vehicle"] = _vehicle(vehicle, path.parent, f"{path}: ")
    if _is_csv(target := data.get("target")):
        data["target"] = read_target(target, path.parent, f"{path}: ")
    if "based_on" not in data:
        return data, given
    base = data["based_on"]
    if base in preset_names():
        below, said = _preset(base), {}
    elif isinstance(base, str) and base.endswith(".toml"):
        if line := misplaced(str(path.parent / base), TASK):
            raise BadInput(f"{path}: based_on: {line}")
        below, said = _from_file(path.parent / base, (*above, resolved))
    else:
        hint = document.nearest(str(base), preset_names())
        raise BadInput(
            f"{path}: based_on: {base!r} is no preset. Allowed: {', '.join(preset_names())}, or a .toml file."
            + (f" Did you mean {hint}?" if hint else "")
        )
    return _laid_over(below, data, str(path), whole_vehicle=named), nested.overlay(said, given)


def _laid_over(
    below: dict[str, Any], data: dict[str, Any], where: str, *, whole_vehicle: bool = False
) -> dict[str, Any]:
    """The tables of a file laid over those of its base, so that it need only say what it changes.

    An empty table of named entries, for instance `termination = {}`, removes all of them.

    Args:
        below: the tables of the base.
        data: those of the file.
        where: the name of the file.
        whole_vehicle: whether its vehicle has a file of its own, and so takes nothing from the base.

    Raises:
        BadInput: the file removes what its base does not have.
    """
    changes = {key: value for key, value in data.items() if key != "based_on"}
    for name in NAMED:
        for key, value in (changes.get(name) or {}).items() if isinstance(changes.get(name), dict) else ():
            if value == NONE:
                _check_there(below, (name, key), f"{where}: ")
        if changes.get(name) == {}:
            below = {**below, name: {}}
    for path, value in nested.leaves(changes, skip=("vehicle", "follow", *nested.LABELS)):
        _check_table(below, path, value, f"{where}: ")
    if isinstance(vehicle := changes.get("vehicle"), dict) and "vehicle" in below and not whole_vehicle:
        changes["vehicle"] = _vehicle_over(below["vehicle"], vehicle)
    if "kind" in _table(changes, "target") and changes["target"]["kind"] != _table(below, "target").get(
        "kind", "point"
    ):
        below = {**below, "sources": _without_target(below.get("sources", {}))}
    if "vehicle" in changes:  # which is laid over already
        below = {key: value for key, value in below.items() if key != "vehicle"}
    return nested.overlay(below, changes)


def _vehicle(name: str, folder: Path = Path(), where: str = "") -> dict[str, Any]:
    """The tables of a vehicle, see `vehicle_table`; what is something else is refused with its use."""
    if name not in vehicle_names() and (line := misplaced(str(folder / Path(name).expanduser()), VEHICLE)):
        raise BadInput(f"{where}vehicle: {line}")
    if (
        name.endswith(".toml")
        and not where
        and not os.path.exists(name)
        and (hint := meant(name, VEHICLE, [], [".toml"]))
    ):
        raise BadInput(f"vehicle: {name}: no such file.{hint}")
    return vehicle_table(name, folder, where)


def _vehicle_over(below: str | dict[str, Any], vehicle: dict[str, Any]) -> dict[str, Any]:
    """A vehicle's table laid over that of the base; one that is complete replaces it."""
    required = {field.name for field in dataclasses.fields(Vehicle) if field.default is field.default_factory}
    if required <= vehicle.keys():
        return vehicle
    base = dict(_vehicle(below) if isinstance(below, str) else below)
    for one, other in (("arm", "rotors"), ("rotors", "arm")):
        if one in vehicle and other not in vehicle:
            base.pop(other, None)
    return nested.overlay(base, vehicle)


def _check_there(tables: dict[str, Any], path: tuple[str, str], prefix: str = "") -> None:
    """Refuse to remove a named entry that does not exist.

    Raises:
        BadInput: there is none; the line names those there are.
    """
    table, name = path
    there = tables.get(table) or {}
    if name not in there:
        hint = document.nearest(name, there)
        raise BadInput(
            f"{prefix}{table}.{name}: there is none that could be removed. There are: {', '.join(there) or 'none'}."
            + (f" Did you mean {table}.{hint}?" if hint else "")
        )


def _check_table(tables: dict[str, Any], path: str, value: Any, prefix: str = "") -> None:
    """Refuse a value in place of a table.

    Raises:
        BadInput: it is one; the line names what is in the table.
    """
    there = nested.look_up(tables, path)
    if path in nested.LABELS or not isinstance(there, dict) or isinstance(value, dict) or value == NONE:
        return
    remove = ' "none" removes it.' if path.partition(".")[0] in NAMED else ""
    what = f"Give one of {', '.join(vehicle_names())}, a .toml file, or edit" if path == "vehicle" else "Edit"
    fields = ", ".join(f"{path}.{each}" for each in there if each not in nested.LABELS)
    raise BadInput(f"{prefix}{path}: {value!r} is not allowed for a table. {what} what is in it: {fields}.{remove}")


def _with_sources(data: dict[str, Any], file: str) -> dict[str, Any]:
    """The tables of a file that changes another task; the source of each changed value without one is the file."""
    sources = data.get("sources", {})
    if "based_on" not in data or not isinstance(sources, dict):  # else it is refused, with its name, when it is read
        return data
    changed = {key: value for key, value in data.items() if key not in ("based_on", "vehicle")}
    data = {**data, "sources": _named_sources(changed, sources, file)}
    vehicle = data.get("vehicle")
    if isinstance(vehicle, dict) and isinstance(vehicle.get("sources", {}), dict):
        data["vehicle"] = {**vehicle, "sources": _named_sources(vehicle, vehicle.get("sources", {}), file)}
    return data


def _named_sources(changed: dict[str, Any], sources: dict[str, str], file: str) -> dict[str, str]:
    paths = (path for path, value in nested.leaves(changed, skip=nested.LABELS) if value != NONE)
    text = f"set in {Path(file).name}"
    return {path: text for path in paths if not document.source_of(path, sources)} | sources


def read_task_text(text: str, where: str) -> Task:
    """A task from its complete TOML text, as `write_task` gives it.

    Raises:
        BadInput: not a task.
    """
    return _read(document.parse(text, where), where)


def write_task(task: Task) -> str:
    """The TOML text of a task: exact, complete, and with unit, range and source beside each number."""
    sources = dict(task.sources) | {f"vehicle.{path}": text for path, text in task.vehicle.sources.items()}
    heading = f"flytune task {task.name}: value  # unit; allowed; source"
    return document.write(task, sources, heading=f"{heading}\n{task.vehicle.name}: {summary(task.vehicle)}")


def _read(data: dict[str, Any], where: str = "") -> Task:
    """The task of complete tables, in which `vehicle` may be a name.

    Raises:
        BadInput: not a task, or one with a key that has another name now.
    """
    for old, new in RENAMED.items():
        if nested.look_up(data, old) is not None:
            raise BadInput(f"{f'{where}: ' if where else ''}{old}: is called {new} now. Write {new} instead.")
    target = _table(data, "target")
    if "position" in target and target.get("kind") in ("circle", "lemniscate", "helix"):
        raise BadInput(
            f"{f'{where}: ' if where else ''}target.position: a {target['kind']} has a centre. Write target.centre."
        )
    if _is_csv(target):
        data = {**data, "target": read_target(target, Path(), f"{where}: " if where else "")}
    vehicle = data.get("vehicle")
    complete = {**data, "vehicle": _vehicle(vehicle)} if isinstance(vehicle, str) else data
    return _at_default(document.read(Task, _without_removed(complete), where), where)


def _table(data: dict[str, Any], name: str) -> dict[str, Any]:
    return data[name] if isinstance(data.get(name), dict) else {}


def _without_target(sources: dict[str, str]) -> dict[str, str]:
    """The sources without those of the target, which has another kind now."""
    return {path: text for path, text in sources.items() if path.split(".")[0] != "target"}


def _is_csv(target: Any) -> TypeGuard[dict[str, Any]]:
    return isinstance(target, dict) and target.get("kind") == "csv"


def _without_removed(data: dict[str, Any]) -> dict[str, Any]:
    """The tables without what is "none", and without the formulas of fields that are gone with it."""
    kept, follow = without_none(Task, data), data.get("follow")
    if isinstance(follow, dict):
        gone = tuple(f"{path}." for path, value in nested.leaves(data, skip=("follow",)) if value == NONE)
        kept["follow"] = {
            path: formula
            for path, formula in follow.items()
            if formula != NONE and not (gone and path.startswith(gone))
        }
    return kept


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
        if value == NONE:
            _check_there(data, ("follow", path.removeprefix("follow.")))
        formula = str(value) if isinstance(value, int | float) and not isinstance(value, bool) else value
        return {**data, "follow": {**data.get("follow", {}), path.removeprefix("follow."): formula}}
    if path == "vehicle" and isinstance(value, str):
        return {**data, "vehicle": _vehicle(value)}
    table, _, name = path.partition(".")
    if value == NONE and table in NAMED and name and "." not in name:
        _check_there(data, (table, name))
    _check_table(data, path, value)
    if path == "target.kind" and isinstance(value, str) and isinstance(data["target"], dict):
        sources = _without_target(data.get("sources", {}))
        data = {**data, "target": of_kind(data["target"], value), "sources": sources}
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
