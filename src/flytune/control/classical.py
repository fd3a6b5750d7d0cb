"""Classical controllers by name, their gains read from gains/NAME.toml: two sets each, textbook and tuned."""

from importlib import resources
from pathlib import Path
from typing import Any

from flytune.config import document
from flytune.config.pytree import label, pytree
from flytune.control.controller import Controller
from flytune.control.geometric import Geometric, GeometricGains
from flytune.control.lqr import LqrGains, make_lqr
from flytune.control.pid import Pid, PidGains
from flytune.control.steering import tighter
from flytune.errors import BadInput
from flytune.task.task import Task

SETS = ("tuned", "textbook")
AnyGains = PidGains | GeometricGains | LqrGains


@pytree
class PidFile:
    """gains/pid.toml."""

    textbook: PidGains
    tuned: PidGains
    sources: dict[str, str] = label(default_factory=dict)


@pytree
class GeometricFile:
    """gains/geometric.toml."""

    textbook: GeometricGains
    tuned: GeometricGains
    sources: dict[str, str] = label(default_factory=dict)


@pytree
class LqrFile:
    """gains/lqr.toml."""

    textbook: LqrGains
    tuned: LqrGains
    sources: dict[str, str] = label(default_factory=dict)


FILES: dict[str, Any] = {"geometric": GeometricFile, "lqr": LqrFile, "pid": PidFile}
CLASSICAL = tuple(FILES)


def classical_controller(name: str, task: Task, gains: str = "tuned") -> Controller:
    """The classical controller of a name for a task's vehicle, target heading and bounds.

    Args:
        name: `pid`, `geometric` or `lqr`.
        task: what it will fly. Its bounds on speed, tilt and body rate become the controller's limits, less the margin
            that the gains leave; a bound the task does not have limits nothing.
        gains: `tuned` or `textbook`.

    Raises:
        BadInput: no such controller or gains.
    """
    if gains not in SETS:
        raise BadInput(f"gains: {gains!r} is not allowed. Allowed: {', '.join(SETS)}.")
    return controller_with(getattr(read_gains(name), gains), task)


def read_gains(name: str, path: Path | None = None) -> PidFile | GeometricFile | LqrFile:
    """Both sets of gains of a controller, from a file or, where None, from the one that ships.

    Raises:
        BadInput: no such controller, or not its gains; one line that names the field.
    """
    if name not in FILES:
        hint = document.nearest(name, list(CLASSICAL))
        raise BadInput(
            f"{name}: no such classical controller. Allowed: {', '.join(CLASSICAL)}."
            + (f" Did you mean {hint}?" if hint else "")
        )
    if path is not None:
        return document.read(FILES[name], document.load(path), str(path))
    with resources.as_file(resources.files("flytune.control") / "gains" / f"{name}.toml") as shipped:
        return document.read(FILES[name], document.load(shipped), f"gains/{name}.toml")


def controller_with(gains: AnyGains, task: Task) -> Controller:
    """The controller whose gains these are, for a task.

    Raises:
        BadInput: the gains give no stabilising feedback.
    """

    def used(quantity: str) -> float | None:
        limit = task.limit(quantity)
        return None if limit is None else float(gains.bound_share) * limit

    limits: dict[str, Any] = {
        "target_yaw": float(task.target.yaw),
        "speed_limit": used("speed"),
        "tilt_limit": tighter(float(gains.largest_tilt), used("tilt")),
        "body_rate_limit": used("body_rate"),
    }
    if isinstance(gains, LqrGains):
        return make_lqr(task.vehicle, gains, **limits)
    if isinstance(gains, GeometricGains):
        return Geometric(gains=gains, vehicle=task.vehicle, **limits)
    return Pid(gains=gains, vehicle=task.vehicle, **limits)
