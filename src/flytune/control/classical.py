"""Classical controllers by name, their gains read from gains/NAME.toml: two sets each, textbook and tuned."""

from importlib import resources
from typing import Any

import jax.numpy as jnp

from flytune.config import document
from flytune.control.controller import Controller
from flytune.control.geometric import Geometric, GeometricGains
from flytune.control.lqr import Lqr, LqrGains, feedback
from flytune.control.pid import Pid, PidGains
from flytune.errors import BadInput
from flytune.task.task import Task

SETS = ("tuned", "textbook")
AnyGains = PidGains | GeometricGains | LqrGains
GAINS: dict[str, Any] = {"geometric": GeometricGains, "lqr": LqrGains, "pid": PidGains}
CLASSICAL = tuple(GAINS)


def classical_controller(name: str, task: Task, gains: str = "tuned") -> Controller:
    """The classical controller of a name for a task's vehicle and bounds.

    Args:
        name: `pid`, `geometric` or `lqr`.
        task: its bounds on speed, tilt and body rate, less a margin from the gains, become the controller's limits; a
            bound that the task does not have limits nothing.
        gains: `tuned` or `textbook`.

    Raises:
        BadInput: no such controller or gains.
    """
    if gains not in SETS:
        hint = document.nearest(gains, SETS)
        raise BadInput(
            f"gains: {gains!r} is not allowed. Allowed: {', '.join(SETS)}." + (f" Did you mean {hint}?" if hint else "")
        )
    return controller_with(read_gains(name)[gains], task)


def read_gains(name: str) -> dict[str, AnyGains]:
    """Both sets of gains of a controller, by the names in `SETS`.

    Raises:
        BadInput: no such controller.
    """
    if name not in GAINS:
        hint = document.nearest(name, CLASSICAL)
        raise BadInput(
            f"{name}: no such classical controller. Allowed: {', '.join(CLASSICAL)}."
            + (f" Did you mean {hint}?" if hint else "")
        )
    file = resources.files("flytune.control") / "gains" / f"{name}.toml"
    tables = document.parse(file.read_text(encoding="utf-8"), f"gains/{name}.toml")
    return {each: document.read(GAINS[name], tables[each], f"gains/{name}.toml: {each}") for each in SETS}


def controller_with(gains: AnyGains, task: Task) -> Controller:
    """The controller whose gains these are, for a task.

    Raises:
        BadInput: the gains give no stabilising feedback.
    """

    def limit(quantity: str) -> float | None:
        bound = task.limit(quantity)
        return None if bound is None else float(gains.bound_share) * bound

    tilts = (float(gains.largest_tilt), limit("tilt"))
    shared: dict[str, Any] = {
        "vehicle": task.vehicle,
        "speed_limit": limit("speed"),
        "tilt_limit": min(tilt for tilt in tilts if tilt is not None),
        "body_rate_limit": limit("body_rate"),
    }
    if isinstance(gains, LqrGains):
        return Lqr(gains=gains, gain=jnp.asarray(feedback(task.vehicle, gains), jnp.float32), **shared)
    if isinstance(gains, GeometricGains):
        return Geometric(gains=gains, **shared)
    return Pid(gains=gains, **shared)
