"""A task: target, initial states, noise, reward, terminations, vehicle and training settings, in one file."""

import dataclasses
import itertools
import math
import os
import re
from importlib import resources
from pathlib import Path
from typing import Annotated, Any, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
from annotated_types import Ge, Gt, Le, Unit
from jaxtyping import Array, Float

from flytune.config import document, nested
from flytune.config.document import Real, Whole
from flytune.config.formula import FUNCTIONS, Formula
from flytune.config.pytree import label, pytree
from flytune.errors import BadInput
from flytune.physics.vehicle import Vehicle, vehicle_table
from flytune.task.dial import Dial, Input, Setting, checked_setting, number_of_inputs, told, with_field
from flytune.task.initial_state import InitialState
from flytune.task.observation import SIZE, ObservationNoise
from flytune.task.reward import RewardTerm
from flytune.task.situation import Target
from flytune.task.termination import Termination
from flytune.task.training_settings import ApgSettings, PpoSettings

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


@pytree
class Task:
    """What a controller has to do, with which vehicle, and how it is trained."""

    name: str = label(default="custom")
    horizon: Annotated[
        Whole, Ge(1), Le(1_000_000), Unit("control steps of 0.01 s")
    ]  # a training episode is truncated after these
    duration: Annotated[Real, Gt(0.5), Le(3600), Unit("s")] = label(default=10.0)  # of a trial in evaluation
    target: Target
    initial_state: InitialState
    noise: ObservationNoise
    reward: dict[str, RewardTerm]
    termination: dict[str, Termination]
    vehicle: Vehicle
    dial: dict[str, Dial] = dataclasses.field(default_factory=dict)  # numbers that may be set at any time
    follow: dict[str, Formula] = dataclasses.field(default_factory=dict)  # field path -> formula of the dials
    input: dict[str, Input] = dataclasses.field(default_factory=dict)  # what the controller is told of the dials
    ppo: PpoSettings = label(default_factory=PpoSettings)
    apg: ApgSettings = label(default_factory=ApgSettings)
    sources: dict[str, str] = label(default_factory=dict)

    def __repr__(self) -> str:
        terms, ends = " ".join(self.reward), " ".join(self.termination)
        return f"Task({self.name} on {self.vehicle.name}, reward: {terms}, termination: {ends})"

    def limit(self, quantity: str) -> float | None:
        """The tightest bound of the terminations on a quantity, in SI units, or None where none bounds it.

        `quantity` is altitude, distance, attitude_error, tilt, speed or body_rate.
        """
        limits = [float(end.limit) for end in self.termination.values() if end.quantity == quantity]
        return (max if quantity == "altitude" else min)(limits, default=None)

    @property
    def speed_bound(self) -> float | None:
        """The tightest bound on speed in m/s, or None where there is none."""
        return self.limit("speed")

    @property
    def inputs(self) -> int:
        """How many numbers a controller of this task is given: 17, and those of its dials."""
        return SIZE + number_of_inputs(self.input)

    def draw(self, key: jax.Array) -> tuple[Any, jax.Array]:
        """The settings of the dials of one episode; without a dial nothing, and the key itself. See `TaskFamily`."""
        if not self.dial:
            return (), key
        key, *keys = jax.random.split(key, 1 + len(self.dial))
        return {name: self.dial[name].draw(each) for name, each in zip(sorted(self.dial), keys, strict=True)}, key

    def turn(self, numbers: Any, key: jax.Array) -> Any:
        """The settings of one episode before the next update: each dial is turned with its probability `turned`."""
        for index, name in enumerate(sorted(self.dial)):
            chance_key, value_key = jax.random.split(jax.random.fold_in(key, index))
            dial = self.dial[name]
            turned = jax.random.uniform(chance_key, ()) < dial.turned
            numbers = {**numbers, name: jnp.where(turned, dial.draw(value_key), numbers[name])}
        return numbers

    def member(self, numbers: Any) -> "Task":
        """The task at a setting of its dials, which all fields in `follow` follow; without a dial the task itself."""
        if not self.dial:
            return self
        fixed = dataclasses.replace(self, dial={}, follow={}, input={})
        numbers = jax.lax.stop_gradient(numbers)
        for path, formula in self.follow.items():
            fixed = with_field(fixed, tuple(path.split(".")), formula.value(numbers))
        return fixed

    def see(self, observation: Float[Array, "*batch 17"], numbers: Any) -> Float[Array, "*batch _"]:
        """What a controller is given of an observation at a setting: the observation and the inputs of the dials."""
        return told(self.input, observation, numbers) if self.input else observation

    def at(self, setting: Setting | None = None) -> "Task":
        """The fixed task at a setting of the dials, a dial that is not named at its default.

        Raises:
            BadInput: an unknown dial, a value out of range, or a field that would have a value that is not allowed.
        """
        values = checked_setting(self.dial, setting or {})
        return _at(self, values) if self.dial else self

    def problem(self) -> str | None:
        """What makes the numbers impossible together, or None."""
        if not self.reward:
            return "reward: no term. Allowed: one or more tables [reward.NAME]."
        if not re.fullmatch(r"[\w .+-]{1,100}", self.name):
            return f"name: {self.name[:100]!r} cannot name a run. Allowed: up to 100 letters, digits and . _ + - signs."
        return _problem_of_dials(self)


@runtime_checkable
class TaskFamily(Protocol):
    """Tasks of one structure that differ in numbers: a bound that a dial sets, a mass that is drawn per episode.

    A `Task` is the family of one: its `draw` draws nothing, and its `member` is the task itself.
    """

    def draw(self, key: jax.Array) -> tuple[Any, jax.Array]:
        """The numbers of one episode, a pytree of scalars, and the key that is left for its initial state."""
        ...

    def member(self, numbers: Any) -> Task:
        """The task with these numbers; inside compiled code they are tracers."""
        ...

    def see(self, observation: Float[Array, "*batch 17"], numbers: Any) -> Float[Array, "*batch _"]:
        """What a controller is given of an observation in an episode with these numbers."""
        ...


def preset_names() -> list[str]:
    """The tasks that ship with flytune."""
    folder = resources.files("flytune.task") / "presets"
    return sorted(entry.name.removesuffix(".toml") for entry in folder.iterdir() if entry.name.endswith(".toml"))


def load_task(task: str | Path, edits: dict[str, Any] | None = None) -> Task:
    """A task by preset name or TOML file, with edits applied.

    Args:
        task: a preset (`baseline`, `acrobatic`, `inspection`, or one of them `-refined`), or the path of a .toml file,
            which may say `based_on = "PRESET"` and then only what it changes.
        edits: field path -> value, for instance {"reward.velocity.weight": 0.08}; `vehicle` also takes a name.

    Raises:
        BadInput: unknown, unreadable, or not a task; one line that names the field.
    """
    name, given = str(task), {}
    if name in preset_names():
        data, where = _preset(name), ""
    elif name.endswith(".toml") or os.path.isfile(name):
        given = document.load(Path(name))
        data = _on_its_base(_with_sources({"name": Path(name).stem, **given}, name), name)
        where = name
    else:
        hint = document.nearest(name, preset_names())
        raise BadInput(
            f"task: {name!r} is no preset. Allowed: {', '.join(preset_names())}, or a .toml file."
            + (f" Did you mean {hint}?" if hint else "")
        )
    task_read = _read(data, where)
    _check_followed(task_read, given, where)
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


FOLLOWING = (
    "target",
    "noise",
    "reward",
    "termination",
    "vehicle",
    "duration",
    "horizon",
)  # parts whose fields may follow a dial
MOST_DIALS = 4  # all their settings together are checked
CHECKED = {1: 9, 2: 5, 3: 4, 4: 3}  # number of dials -> settings of each at which a task is checked


def _problem_of_dials(task: Task) -> str | None:
    """What makes the dials of a task and what follows them impossible, or None."""
    if len(task.dial) > MOST_DIALS:
        return f"dial: {len(task.dial)} dials are not allowed. Allowed: up to {MOST_DIALS}."
    if not task.dial and (task.follow or task.input):
        return "dial: no dial, though `follow` or `input` needs one. Allowed: one or more tables [dial.NAME]."
    for name in task.dial:
        if not name.isidentifier() or name in FUNCTIONS:
            return f"dial.{name}: cannot be used in a formula. Allowed: letters, digits and _, no name of a function."
    formulas = {f"follow.{path}": formula for path, formula in task.follow.items()}
    formulas |= {f"input.{name}.value": each.value for name, each in task.input.items()}
    for where, formula in formulas.items():
        try:
            unknown = formula.names() - set(task.dial)
        except ValueError as error:
            return f"{where}: {str(formula)[:60]!r}: {error}."
        if unknown:
            return f"{where}: {min(unknown)} is no dial. Allowed: {', '.join(task.dial)}."
    for path in task.follow:
        if path.split(".")[0] not in FOLLOWING:
            return f"follow.{path}: cannot follow a dial. Allowed: a field of {', '.join(FOLLOWING)}."
    return None


def _check_followed(task: Task, given: dict[str, Any], where: str) -> None:
    """Refuse a file that gives a field another value than the formula that it follows.

    Raises:
        BadInput: the field, its value and its formula.
    """
    plain = document.plain(task)
    for path, formula in task.follow.items():
        value, now = nested.look_up(given, path), nested.look_up(plain, path)
        same = isinstance(value, int | float) and math.isclose(value, now, rel_tol=1e-6)
        if value is not None and not same:
            raise BadInput(
                f"{where}: {path}: {value} is not allowed, since it follows the dials as {formula}, which is {now:g} "
                "at their defaults. Leave it out, or change its formula in [follow]."
            )


def _at_default(task: Task, where: str) -> Task:
    """The task, where the fields that follow dials have their values at the default setting; all settings checked.

    Raises:
        BadInput: a field in `follow` does not exist, or has a value that is not allowed at some setting.
    """
    if not task.dial:
        return task
    prefix = f"{where}: " if where else ""
    settings = itertools.product(*(dial.trained_grid(CHECKED[len(task.dial)]) for dial in task.dial.values()))
    default = {name: dial.default for name, dial in task.dial.items()}
    for values in settings:
        _at(task, dict(zip(task.dial, values, strict=True)), prefix)
    at_default = _at(task, default, prefix)
    return dataclasses.replace(at_default, dial=task.dial, follow=task.follow, input=task.input)


def _at(task: Task, setting: Setting, prefix: str = "") -> Task:
    """The fixed task at a setting of all dials, every value checked."""
    plain = document.plain(task)
    for path, formula in task.follow.items():
        if nested.look_up(plain, path) is None or isinstance(nested.look_up(plain, path), dict):
            raise BadInput(f"{prefix}follow.{path}: the task has no such number. Allowed: the path of a field.")
        value = _value(formula, setting, f"{prefix}follow.{path}")
        plain = nested.edit(plain, path, math.ceil(value) if path == "horizon" else value)  # of whole steps
    for name, each in task.input.items():
        _value(each.value, setting, f"{prefix}input.{name}.value")
    rest = {key: value for key, value in plain.items() if key not in ("dial", "follow", "input")}
    try:
        return document.read(Task, rest)
    except BadInput as error:
        raise BadInput(f"{prefix}at {_words(setting)}: {error}") from None


def _value(formula: Formula, setting: Setting, where: str) -> float:
    try:
        return formula.value(setting)
    except (ArithmeticError, ValueError) as error:
        raise BadInput(f"{where}: {formula} has no value at {_words(setting)} ({error}).") from None


def _words(setting: Setting) -> str:
    return ", ".join(f"{name} {value:g}" for name, value in setting.items())
