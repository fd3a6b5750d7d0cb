"""The parts that flytune's two Gymnasium environments share: task, spaces, checks of arguments, and pictures."""

from collections import deque
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from flytune.errors import BadInput, require
from flytune.physics.dynamics import CONTROL_PERIOD
from flytune.simulation.host import HostEnvironment
from flytune.simulation.simulator import VehicleStates
from flytune.task.agreement import check_starts
from flytune.task.files import load_task
from flytune.task.observation import SIZE
from flytune.task.task import Task

if TYPE_CHECKING:
    import gymnasium
else:
    gymnasium = require("gymnasium", "gymnasium")  # a missing one in one line

METADATA = {"render_modes": ["rgb_array"], "render_fps": round(1 / CONTROL_PERIOD)}
TRAIL = 300  # steps of the way behind a vehicle that a picture shows
FARTHEST = 1000.0  # m, also rad: of a start given by hand


def read_task(task: str | Path | Task, edits: dict[str, Any] | None) -> Task:
    """The task by preset name or file, edited, or the Task itself.

    Raises:
        BadInput: no such task, edits of a Task, or a task whose episodes end as they begin.
    """
    if isinstance(task, Task) and edits:
        raise BadInput(
            "edits: a Task cannot be edited here. Allowed: edits of a preset or a file. Edit the Task itself."
        )
    read = task if isinstance(task, Task) else load_task(task, edits)
    check_starts(read)
    return read


def make_spaces() -> tuple[gymnasium.spaces.Box, gymnasium.spaces.Box]:
    """The spaces of one observation and one action."""
    largest = float(np.finfo(np.float32).max)  # infinite bounds would mean the same, but `check_env` warns of them
    observation = gymnasium.spaces.Box(-largest, largest, (SIZE,), np.float32)
    return observation, gymnasium.spaces.Box(-1.0, 1.0, (4,), np.float32)


def read_action(action: Any, shape: tuple[int, ...]) -> np.ndarray:
    """The action as float32 of that shape.

    Raises:
        InvalidAction: another shape, no numbers, or not finite.
    """
    try:
        numbers = np.asarray(action, np.float32)
    except (TypeError, ValueError):
        raise gymnasium.error.InvalidAction(f"action: {action!r} is no array of numbers. Allowed: {shape}.") from None
    if numbers.shape != shape:
        raise gymnasium.error.InvalidAction(f"action: shape {numbers.shape} is not allowed. Allowed: {shape}.")
    if not np.isfinite(numbers).all():
        raise gymnasium.error.InvalidAction("action: not every number is finite. Allowed: -1 to 1, others are clipped.")
    return numbers


def read_start(options: dict[str, Any] | None) -> dict[str, Any] | None:
    """The start in the options of `reset`, None where they have none.

    Raises:
        BadInput: an unknown option or an impossible start.
    """
    if not options:
        return None
    _refuse_unknown(options, ("position", "yaw"))
    if "position" not in options:
        raise BadInput("options.position: is missing. Allowed: [x, y, z] in metres, beside yaw.")
    for name, shape, allowed in (("position", (3,), "three numbers"), ("yaw", (), "one number")):
        given = options.get(name, 0.0)
        try:
            numbers = np.asarray(given, float)
        except (TypeError, ValueError):
            numbers = np.array(np.nan)
        if numbers.shape != shape or not (np.abs(numbers) <= FARTHEST).all():
            raise BadInput(f"options.{name}: {given!r} is not allowed. Allowed: {allowed} within {FARTHEST}.")
    return {"position": options["position"], "yaw": options.get("yaw", 0.0)}


def read_mask(options: dict[str, Any] | None, number: int) -> np.ndarray | None:
    """The mask in the options of a vector environment's `reset`, None for all environments.

    Raises:
        BadInput: an unknown option, or a mask that is none.
    """
    if not options:
        return None
    _refuse_unknown(options, ("reset_mask",))
    mask = np.asarray(options["reset_mask"])
    if mask.shape != (number,) or mask.dtype != np.bool_ or not mask.any():
        raise BadInput(
            f"options.reset_mask: {mask.dtype} of shape {mask.shape} is not allowed. "
            f"Allowed: bool of shape ({number},), at least one of them true."
        )
    return mask


def _refuse_unknown(options: dict[str, Any], known: tuple[str, ...]) -> None:
    for name in options:
        if name not in known:
            raise BadInput(f"options.{name}: is unknown. Allowed: {', '.join(known)}.")


class Pictures:
    """The pictures of the vehicles of an environment, with the way they came; nothing is kept without a render mode.

    Raises:
        BadInput: an unknown render mode, or Pillow is not installed.
    """

    def __init__(self, render_mode: str | None) -> None:
        if render_mode not in (None, "rgb_array"):
            raise BadInput(f"render_mode: {render_mode!r} is not allowed. Allowed: None, rgb_array.")
        if render_mode is not None:
            require("PIL.Image", "gymnasium")
        self._wanted = render_mode is not None
        self._trail: deque[np.ndarray] = deque(maxlen=TRAIL)

    def follow(self, environment: HostEnvironment) -> None:
        """Remember where the vehicles are."""
        if self._wanted:
            self._trail.append(environment.states[:, :3])

    def draw(self, environment: HostEnvironment, rewards: np.ndarray) -> tuple[np.ndarray, ...] | None:
        """A picture of each vehicle, with the rewards [N] of its last step; None without a render mode.

        Raises:
            ResetNeeded: before the first reset.
        """
        if not self._wanted:
            gymnasium.logger.warn('render() needs render_mode="rgb_array", given when the environment is made.')
            return None
        if not self._trail:
            raise gymnasium.error.ResetNeeded("render() was called before the first reset. Call reset() first.")
        trail = np.array(self._trail)
        return tuple(
            _picture(environment.task, state, trail[-(steps + 1) :, index], int(steps), float(reward))
            for index, (state, steps, reward) in enumerate(
                zip(environment.states, environment.steps(), rewards, strict=True)
            )
        )


def _picture(task: Task, numbers: np.ndarray, trail: np.ndarray, steps: int, reward: float) -> np.ndarray:
    from flytune.adapters import picture  # here, because it needs Pillow

    state = VehicleStates.from_rows(np.nan_to_num(numbers).astype(float))
    distance = np.linalg.norm(numbers[:3] - np.array(task.target.position, float))
    lines = (
        ("time", f"{steps * CONTROL_PERIOD:.2f} s"),
        ("distance", f"{distance:.3f} m"),
        ("speed", f"{np.linalg.norm(state.velocity):.2f} m/s"),
        ("reward", f"{reward:.3f}"),
    )
    way = np.nan_to_num(trail).astype(float)
    return picture.draw(picture.Scene(vehicle=task.vehicle, target=task.target, state=state, trail=way, lines=lines))
