"""Whether starts, target and terminations agree: a task is refused whose episodes all end as soon as they begin."""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float

from flytune.config import document
from flytune.errors import BadInput
from flytune.physics.dynamics import CONTROL_PERIOD
from flytune.task.following import settings_to_check, words
from flytune.task.initial_state import InitialState
from flytune.task.task import Task
from flytune.task.termination import Bounded

FEWEST = 0.05  # share of the starts that have to survive; of fewer nothing is learned
STARTS = 2000  # that are drawn to measure it
WORDS = {  # quantity -> what starts are like, and the factor of their numbers from SI units
    "altitude": ("are {low:.3g} to {high:.3g} m high", 1.0),
    "distance": ("lie {low:.3g} to {high:.3g} m from the target", 1.0),
    "attitude_error": ("are turned by {low:.3g} to {high:.3g} rad from the target", 1.0),
    "tilt": ("are tilted by {low:.3g} to {high:.3g} deg", 180 / math.pi),
    "speed": ("give a speed of {low:.3g} to {high:.3g} m/s before the vehicle is level", 1.0),
}


def check_starts(
    task: Task, initial_state: InitialState | None = None, where: str = "initial_state", slack: float = 0.0
) -> None:
    """Refuse a task that cannot be learned, at any setting of its dials; see `disagreement`.

    Args:
        task: the task.
        initial_state: where its episodes begin, its own where None.
        where: the path of that table, for the message.
        slack: share of a bound by which it may be passed before an episode ends.

    Raises:
        BadInput: the bound, its value, what starts are like, and the remedy.
    """
    for setting in settings_to_check(task.dial) if task.dial else [{}]:
        fixed = task.fixed_at(setting) if setting else task
        if problem := disagreement(fixed, initial_state or task.initial_state, where, slack):
            raise BadInput(f"at {words(setting)}: {problem}" if setting else problem)


def disagreement(task: Task, initial_state: InitialState, where: str, slack: float = 0.0) -> str | None:
    """What makes (nearly) all episodes of a fixed task end as they begin, or its target unreachable; else None.

    Args:
        task: a task without dials, its numbers plain.
        initial_state: where its episodes begin.
        where: the path of that table, for the message.
        slack: share of a bound by which it may be passed before an episode ends.
    """
    if problem := initial_state.problem_around(task.target):
        return f"{where}.{problem}"
    height = float(task.target.position[2])
    for name, end in task.termination.items():
        if end.quantity == "altitude" and not height > end.limit:
            return (
                f"termination.{name}.bound: {end.limit:g} m is not below the target, which is {height:g} m high, so "
                f"that an episode ends before it arrives. Give a bound below {height:g} m, or a higher target.position."
            )
    starts = _quantities(task, initial_state)
    alive = {name: _kept(end, starts, slack) for name, end in task.termination.items() if end.quantity in starts}
    if not alive or np.mean(np.logical_and.reduce(list(alive.values()))) >= FEWEST:
        return None
    worst = min(alive, key=lambda name: np.mean(alive[name]))
    return _message(worst, task.termination[worst], starts, where, float(np.mean(alive[worst])))


def _kept(end: Bounded, starts: Mapping[str, np.ndarray], slack: float) -> np.ndarray:
    """Which starts lie within a bound."""
    limit, values = float(end.limit), starts[end.quantity]
    if end.quantity == "altitude":
        return values >= limit - slack * (limit if limit > 0 else 1.0)  # the unit of its margin
    return values <= limit * (1 + slack)


def _quantities(task: Task, initial_state: InitialState) -> dict[str, Float[np.ndarray, "N"]]:
    """What the terminations bound, at many starts, in SI units."""
    share = np.random.default_rng(0).random((6, STARTS))
    offset = np.array([float(each) for each in initial_state.moved(task.target)])
    low, high = (
        np.array(each, float) + offset for each in (initial_state.lowest_position, initial_state.highest_position)
    )
    low[2] = max(low[2], initial_state.lowest_altitude)
    position = low + (high - low) * share[:3].T
    roll, pitch = float(initial_state.largest_tilt) * (2 * share[3:5] - 1)
    yaw = float(initial_state.largest_yaw) * (2 * share[5] - 1)
    real = np.prod([np.cos(each / 2) for each in (roll, pitch, yaw)], axis=0)
    real += np.prod([np.sin(each / 2) for each in (roll, pitch, yaw)], axis=0)
    level = np.cos(roll) * np.cos(pitch)  # the z component of the body's z axis
    tilts = np.arctan2(np.cos(pitch) * np.sin(roll), level), np.arcsin(np.sin(pitch))
    return {
        "altitude": position[:, 2],
        "distance": np.linalg.norm(position - np.array(task.target.position, float), axis=-1),
        "attitude_error": 2 * np.arccos(np.minimum(np.abs(real), 1.0)),
        "tilt": np.abs(tilts).max(axis=0),
        "speed": _speed_gained(task, np.arccos(np.clip(level, -1, 1))),
    }


def _speed_gained(task: Task, tilt: Float[np.ndarray, "N"]) -> Float[np.ndarray, "N"]:
    """The horizontal speed in m/s that a start at rest gains before it is level, from its tilt in rad.

        v = g sin(tilt) t0 + g sin(tilt)^2 / (2 w)

    For t0, one control period and the action latency, nothing answers; then the vehicle turns level at the bound on
    its body rate w, with a thrust that just leaves no acceleration along itself, g cos(tilt). A larger tilt than a
    right angle counts as one.
    """
    steep = np.sin(np.minimum(tilt, math.pi / 2))
    rate, gravity = task.limit("body_rate"), float(task.vehicle.gravity)
    waits = (1 + task.vehicle.action_latency_steps) * CONTROL_PERIOD
    return gravity * steep * waits + (0.0 if rate is None else gravity * steep**2 / (2 * rate))


def _message(name: str, end: Any, starts: Mapping[str, np.ndarray], where: str, kept: float) -> str:
    values = starts[end.quantity]
    text, factor = WORDS[end.quantity]
    low, high = factor * float(values.min()), factor * float(values.max())
    remedy = f"of at most {low:.3g}" if end.quantity == "altitude" else f"of at least {high:.3g}"
    share = "every episode" if kept == 0 else f"{1 - kept:.3g} of all episodes"
    unit = document.unit_of(type(end), {}, end.key)
    slower = ", or a larger bound on the body rate" if end.quantity == "speed" else ""
    slip = f" If it is in rad, write {math.degrees(end.bound_deg):.3g}." if _looks_like_rad(end) else ""
    return (
        f"termination.{name}.{end.key}: {getattr(end, end.key):g} {unit} ends {share} at the start, since the starts "
        f"in [{where}] {text.format(low=low, high=high)}. Give a bound {remedy} {unit}, or other starts{slower}.{slip}"
    )


def _looks_like_rad(end: Any) -> bool:
    return end.key == "bound_deg" and end.bound_deg <= math.pi
