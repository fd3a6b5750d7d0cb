"""Controllers by name: the meaning of CONTROLLER on the command line."""

import dataclasses
import json
import os
import re
from pathlib import Path
from typing import Any

import jax

from flytune.config import document, nested
from flytune.config.recognise import CONTROLLER, meant, misplaced
from flytune.control.classical import CLASSICAL, classical_controller
from flytune.control.controller import Controller
from flytune.control.policy import Policy, load_policy
from flytune.control.response_map import response_map
from flytune.control.schedule import Schedule, with_schedule
from flytune.errors import BadInput
from flytune.export.untrusted.onnx_controller import load_onnx
from flytune.export.untrusted.sb3_model import load_sb3
from flytune.runs.directory import has_checkpoint, read_facts, resume_command
from flytune.runs.shipped import shipped_files, shipped_names
from flytune.task.dial import as_number
from flytune.task.files import load_task, read_task_text, write_task
from flytune.task.task import Task

SETTLING_TIME = "settling_time"
SCALED = ".zip@vecnormalize="  # between a model and the file of statistics that scaled its observations
READERS = {".safetensors": load_policy, ".onnx": load_onnx, ".zip": load_sb3}
KINDS = f"a run directory, a policy file ({', '.join(READERS)}), {', '.join(CLASSICAL)}"


@dataclasses.dataclass(frozen=True, kw_only=True)
class FoundController:
    """A controller, the task it flies, and how it was made; it is used like the controller itself."""

    name: str
    controller: Controller
    task: Task  # the one asked for, else the one it was trained for, else the baseline
    metrics: list[dict[str, Any]] | None = None  # of its training, one row per update; None where it has none
    about: dict[str, str] = dataclasses.field(default_factory=dict)  # facts for a reader
    trained: Task | None = None  # the task of its training; None where it says none, or was not trained

    def made_for(self, task: Task) -> str:
        """The vehicle of its training, where that is another one than the task has; else nothing."""
        if self.trained is None:
            return ""
        own, flown = self.trained.vehicle, task.vehicle
        other = nested.first_difference(document.plain(own), document.plain(flown))
        return "" if other is None else own.name if own.name != flown.name else f"{own.name} with another {other}"

    def initial_memory(self) -> Any:
        """The memory of the controller before its first observation."""
        return self.controller.initial_memory()

    def act(self, memory: Any, observation: Any) -> Any:
        """The memory and the action of the controller, see `Controller`."""
        return self.controller.act(memory, observation)

    def with_dial(self, schedule: Schedule, name: str = "") -> "FoundController":
        """The controller with its dials set or scheduled, see `with_schedule`.

        The name `settling_time` stands for the setting whose median settling time, by the response map that the policy
        carries, is the value in s.

        Raises:
            BadInput: the controller has no dial, an unknown dial, or a value out of range.
        """
        controller: Any = self.controller
        if not getattr(controller, "dials", {}):
            raise BadInput(
                f"{self.name}: has no dial. Allowed: a policy with dials, for instance dial@speed=0.5; "
                "`flytune train dial` trains one."
            )
        schedule = dict(schedule)
        names = [*controller.dials, SETTLING_TIME]
        if unknown := next((each for each in schedule if each not in names), None):
            hint = document.nearest(unknown, names)
            raise BadInput(
                f"dial: {unknown!r} is no dial here. Allowed: {', '.join(names)}."
                + (f" Did you mean {hint}?" if hint else "")
            )
        if SETTLING_TIME in schedule and SETTLING_TIME not in controller.dials:
            self._check_measured_on_this_vehicle()
            schedule |= _by_settling_time(self.name, controller, schedule.pop(SETTLING_TIME), schedule)
        return dataclasses.replace(self, controller=with_schedule(controller, schedule), name=name or self.name)

    def _check_measured_on_this_vehicle(self) -> None:
        """Refuse a settling time where the task has another vehicle than that of the response map.

        Raises:
            BadInput: the vehicles differ.
        """
        controller: Any = self.controller
        text = controller.about.get("task_toml")
        measured = read_task_text(text, self.name).vehicle if text else self.task.vehicle
        if nested.first_difference(document.plain(measured), document.plain(self.task.vehicle)) is not None:
            dial = next(iter(controller.dials))
            raise BadInput(
                f"settling_time: the response map of {self.name} was measured with the vehicle {measured.name}, and "
                f"this task flies {self.task.vehicle.name}. Set the dial itself, {self.name}@{dial}=VALUE, or let "
                "flytune find it: flytune tune TASK --settling-time S."
            )

    def fixed(self) -> Policy:
        """The policy at its setting without its dials, with the task at this setting in its header.

        Raises:
            BadInput: it is no policy with weights at one setting.
        """
        if not isinstance(self.controller, Policy):
            raise BadInput(
                f"{self.name}: cannot be written at one setting. Allowed: a policy with its weights, from a run "
                "directory, a .safetensors file, or one that ships; its dials not turned in flight."
            )
        return fixed_policy(self.controller, self.task)

    def __repr__(self) -> str:
        return f"FoundController({self.name}, {self.controller!r}, for {self.task.name})"


def _bare(_: None, children: tuple[Controller]) -> Any:
    return children[0]


# compiled code sees only the controller
jax.tree_util.register_pytree_node(FoundController, lambda found: ((found.controller,), None), _bare)


def find_controller(name: str, task: str | Task | None = None) -> FoundController:
    """The controller that a run directory, a policy file or the name of a classical controller stands for.

    A policy file is one of flytune, ONNX or a Stable-Baselines3 model `model.zip`; classical controllers are `pid`,
    `geometric` and `lqr` (gains tuned by search; `pid@textbook` for those of the books). A policy with dials may be
    followed by a setting, as in `dial@speed=0.5` or `dial@settling_time=4`, and a Stable-Baselines3 model by the file
    of its statistics, as in `model.zip@vecnormalize=vecnormalize.pkl`. `task` is the task to fly, a preset, a TOML
    file or a task; where None, that of the controller's training, or the baseline.

    Raises:
        BadInput: no controller has this name, or it cannot be used.
    """
    wanted = load_task(task) if isinstance(task, str) else task
    base, setting = split_setting(name)
    if setting:
        return find_controller(base, wanted).with_dial(setting, name)
    if SCALED in name and not os.path.exists(name):
        model, _, statistics = name.partition(SCALED)
        given = statistics if statistics == "none" else Path(statistics)
        return _from_file(name, Path(f"{model}.zip"), wanted, statistics=given)
    path = Path(name)
    if os.path.isdir(name):  # unlike Path.is_dir, also where the name is too long to be one
        return _from_run(name, path, wanted)
    if line := misplaced(name, CONTROLLER):
        raise BadInput(line)
    if path.suffix in READERS and not os.path.exists(name) and (hint := meant(name, CONTROLLER, [], READERS)):
        raise BadInput(f"{name}: no such file.{hint}")
    if path.suffix in READERS or os.path.isfile(name):
        return _from_file(name, path, wanted)
    kind, at, gains = name.partition("@")
    if kind in CLASSICAL:
        wanted = (wanted or load_task("baseline")).at()  # it has no dial: those of the task are at their defaults
        controller = classical_controller(kind, wanted, gains if at else "tuned")
        about = {"controller": kind, "gains": gains or "tuned"}
        return FoundController(name=name, controller=controller, task=wanted, about=about)
    if name in shipped_names():
        return _shipped(name, wanted)
    hint = meant(name, CONTROLLER, [*CLASSICAL, *shipped_names()], READERS)
    raise BadInput(
        f"{name}: no such controller. Allowed: {KINDS}{''.join(f', {each}' for each in shipped_names())}.{hint}"
    )


def fixed_policy(policy: Policy, task: Task) -> Policy:
    """The policy at its setting without its dials; its header names the setting and holds the task at this setting."""
    fixed_task = task.at({name: value for name, value in policy.setting.items() if name in task.dial})
    words = ", ".join(f"{name}={float(value):g}" for name, value in policy.setting.items())
    about = {**policy.about, "task_toml": write_task(fixed_task), **({"dial": words} if words else {})}
    return dataclasses.replace(policy.fixed(), about=about)


def _by_settling_time(name: str, controller: Any, wanted: Any, given: Schedule) -> dict[str, float]:
    """The setting of a dial that gives a settling time in s, by the response map that a policy carries.

    Raises:
        BadInput: the policy has no map, the map does not cover this time, or the dial is among those `given` as well.
    """
    known = response_map(controller)
    if known is None:
        raise BadInput(f"{name}: carries no response map. Set its dial: {', '.join(controller.dials)}.")
    time = as_number(wanted)
    if time is None or not known.covers(time):
        fastest, slowest = known.range()
        raise BadInput(
            f"settling_time: {wanted} is not allowed. Allowed: {fastest:.2f} to {slowest:.2f} s with {name}; "
            "`flytune tune --settling-time S` trains a policy for other times."
        )
    if known.dial in given:
        raise BadInput(f"settling_time: sets the dial {known.dial}, which is given as well. Give one of the two.")
    return {known.dial: known.setting_for(time)}


def split_setting(name: str) -> tuple[str, dict[str, Any]]:
    """The name of a controller and the setting of its dials, from a name such as `dial@speed=0.5`."""
    base, at, setting = name.rpartition("@")
    if not at or "=" not in setting or SCALED in name or os.path.exists(name):
        return name, {}
    return base, dict(map(document.parse_assignment, re.split(r",(?=[^,\]]*=)", setting)))


def _from_file(name: str, path: Path, wanted: Task | None, **given: Any) -> FoundController:
    policy = READERS.get(path.suffix, load_policy)(path, **given)
    about = {key: str(value) for key, value in policy.about.items() if key != "task_toml"}
    text = policy.about.get("task_toml")
    trained = read_task_text(text, name) if text else None
    task = wanted or trained or load_task("baseline")
    return FoundController(name=name, controller=policy, task=task, about=about, trained=trained)


def _shipped(name: str, wanted: Task | None) -> FoundController:
    path, record = shipped_files(name)
    facts = json.loads(record.read_text(encoding="utf-8"))
    found = _from_file(name, path, wanted)
    return dataclasses.replace(found, about=found.about | {"trained": facts["time"], "commit": str(facts["commit"])})


def _from_run(name: str, path: Path, wanted: Task | None) -> FoundController:
    facts = read_facts(path)
    if not (path / "policy.safetensors").exists():
        command = resume_command(path, facts["trainer"], facts["seed"])
        remedy = f"Continue it with: {command}" if has_checkpoint(path) else "Train again into another directory."
        raise BadInput(f"{name}: its training has not ended. {remedy}")
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
    trained = load_task(path / "task.toml")
    return FoundController(
        name=name, controller=policy, task=wanted or trained, metrics=metrics, about=about, trained=trained
    )


def _read_metrics(path: Path) -> list[dict[str, Any]] | None:
    if not path.exists():
        return None
    try:
        rows = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
        if not all(isinstance(row, dict) for row in rows):
            raise ValueError("a line is not a JSON object")
    except (OSError, ValueError) as error:
        raise BadInput(
            f"{path}: is damaged ({error}). Remove this file; reports then have no learning curve."
        ) from None
    return rows
