"""The parts that flytune's environments share (Gymnasium's and Stable-Baselines3's): task, spaces, starts, pictures."""

import dataclasses
import math
from collections import deque
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np

from flytune.errors import BadInput, require
from flytune.physics.dynamics import hovering
from flytune.physics.rotation import from_euler
from flytune.simulation.host import HostEnvironment, episodes_at
from flytune.simulation.simulator import VehicleStates, state_numbers
from flytune.task.agreement import check_starts
from flytune.task.files import load_task
from flytune.task.observation import RATE, SIZE
from flytune.task.target import target_at
from flytune.task.task import Task

if TYPE_CHECKING:
    import gymnasium
else:
    gymnasium = require("gymnasium", "gymnasium")  # a missing one in one line

METADATA = {"render_modes": ["rgb_array"], "render_fps": RATE}
TRAIL = 300  # steps of the way behind a vehicle that a picture shows
FARTHEST = 1000.0  # m, also rad: of a start given by hand


def read_task(task: str | Path | Task, edits: dict[str, Any] | None, max_episode_steps: Any = None) -> Task:
    """The task by preset name or file, edited, or the Task itself; its horizon is at most `max_episode_steps`.

    Raises:
        BadInput: no such task, edits of a Task, or a task whose episodes end as they begin.
    """
    if max_episode_steps is not None:
        if not isinstance(max_episode_steps, int | np.integer) or max_episode_steps < 1:
            raise BadInput(
                f"max_episode_steps: {max_episode_steps!r} is not allowed. Allowed: a whole number, 1 or more."
            )
        whole = read_task(task, edits)
        wanted = math.ceil(max_episode_steps * RATE / whole.vehicle.control_rate)
        return dataclasses.replace(whole, horizon=min(int(whole.horizon), wanted))
    if isinstance(task, Task) and edits:
        raise BadInput(
            "edits: a Task cannot be edited here. Allowed: edits of a preset or a file. Edit the Task itself."
        )
    read = task if isinstance(task, Task) else load_task(task, edits)
    check_starts(read)
    return read


def make_spaces() -> tuple[gymnasium.spaces.Box, gymnasium.spaces.Box]:
    """The spaces of one observation and one action, the same in every environment.

    The observation is unbounded, as in Gymnasium's own robots and in gym-pybullet-drones: a finite box would have to
    depend on the task, and a model of one task could not be loaded for another.
    """
    observation = gymnasium.spaces.Box(-np.inf, np.inf, (SIZE,), np.float32)
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


def read_starts(options: dict[str, Any] | None, number: int) -> tuple[np.ndarray, np.ndarray] | None:
    """The starts in the options of `reset`, None where they have none: positions [N, 3] in m, and yaws [N] in rad.

    One start serves all N environments; `position` may also be [N, 3], and `yaw` [N].

    Raises:
        BadInput: an impossible start.
    """
    if not options or not {"position", "yaw"} & set(options):
        return None
    if "position" not in options:
        raise BadInput("options.position: is missing. Allowed: [x, y, z] in metres, beside yaw.")
    read = []
    for name, shape, allowed in (("position", (3,), "three numbers"), ("yaw", (), "one number")):
        given = options.get(name, 0.0)
        try:
            numbers = np.asarray(given, float)
        except (TypeError, ValueError):
            numbers = np.array(np.nan)
        if numbers.shape not in (shape, (number, *shape)) or not (np.abs(numbers) <= FARTHEST).all():
            each = f", or {number} times as many" if number > 1 else ""
            raise BadInput(f"options.{name}: {given!r} is not allowed. Allowed: {allowed}{each} within {FARTHEST}.")
        read.append(np.broadcast_to(numbers, (number, *shape)))
    return read[0], read[1]


def start_at(
    environment: HostEnvironment,
    starts: tuple[np.ndarray, np.ndarray],
    noise: Any = None,
    which: np.ndarray | None = None,
) -> np.ndarray:
    """The observations [N, 17] after new episodes that begin at given positions and yaws, level and at rest.

    Args:
        environment: of N episodes.
        starts: positions [N, 3] in m, and yaws [N] in rad.
        noise: 13 standard normal numbers for each observation, [13, N]; drawn by the environment where None.
        which: the mask [N] of those that begin anew, all where None.
    """
    episodes = episodes_at(environment.task, _states_at(environment.task, *map(np.float32, starts)))
    return environment.start(episodes, noise, which)


@jax.jit
def _states_at(task: Task, positions: Any, yaws: Any) -> Any:
    def one(position: Any, yaw: Any) -> Any:
        return state_numbers(hovering(task.vehicle, tuple(position), from_euler(0.0 * yaw, 0.0 * yaw, yaw)))

    return jax.vmap(one, out_axes=-1)(positions, jnp.asarray(yaws))


def read_mask(options: dict[str, Any] | None, number: int) -> np.ndarray | None:
    """The mask in the options of a vector environment's `reset`, None for all environments.

    Raises:
        BadInput: a mask that is none.
    """
    if not options or "reset_mask" not in options:
        return None
    mask = np.asarray(options["reset_mask"])
    if mask.shape != (number,) or mask.dtype != np.bool_ or not mask.any():
        raise BadInput(
            f"options.reset_mask: {mask.dtype} of shape {mask.shape} is not allowed. "
            f"Allowed: bool of shape ({number},), at least one of them true."
        )
    return mask


def refuse_unknown(options: dict[str, Any] | None, *known: str) -> None:
    """Refuse options of `reset` that are not known.

    Raises:
        BadInput: an unknown option.
    """
    for name in options or {}:
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
    target = target_at(task.target, steps * task.vehicle.control_period)
    distance = np.linalg.norm(numbers[:3] - np.array(target.position, float))
    lines = (
        ("time", f"{steps * task.vehicle.control_period:.2f} s"),
        ("distance", f"{distance:.3f} m"),
        ("speed", f"{np.linalg.norm(state.velocity):.2f} m/s"),
        ("reward", f"{reward:.3f}"),
    )
    way = np.nan_to_num(trail).astype(float)
    return picture.draw(picture.Scene(vehicle=task.vehicle, target=target, state=state, trail=way, lines=lines))
