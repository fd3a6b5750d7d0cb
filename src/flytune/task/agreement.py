"""Whether starts, target and terminations agree: a task is refused whose episodes all end as soon as they begin."""

import dataclasses
import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from flytune.config import document
from flytune.errors import BadInput
from flytune.kernels.programs import program
from flytune.physics import rotation
from flytune.physics.components import Components
from flytune.physics.vehicle import Vehicle
from flytune.task.following import settings_to_check, words
from flytune.task.initial_state import InitialState
from flytune.task.situation import situation
from flytune.task.task import Task

FEWEST = 0.05  # share of the starts that have to survive; of fewer nothing is learned
STARTS = 2000  # that are drawn to measure it
WORDS = {  # quantity that starts decide -> what they are like, and the factor of their numbers from SI units
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
                f"that an episode ends before it arrives. Give a bound below {height:g} m, or a higher target."
            )
    rate = task.limit("body_rate")
    measures, inside = _starts(task, initial_state, np.float32(slack), np.float32(math.inf if rate is None else rate))
    checked = [name for name, end in task.termination.items() if end.quantity in WORDS]
    alive = {name: np.asarray(inside[name]) for name in checked}
    if not alive or np.mean(np.logical_and.reduce(list(alive.values()))) >= FEWEST:
        return None
    worst = min(alive, key=lambda name: np.mean(alive[name]))
    return _message(worst, task.termination[worst], measures[worst], where, float(np.mean(alive[worst])))


@program()
def _starts(task: Task, initial_state: InitialState, slack: Any, rate_limit: Any) -> tuple[dict[str, Any], ...]:
    """What each termination bounds [N], and whether it goes on [N], at many starts.

    Args:
        task: a task without dials.
        initial_state: where its episodes begin.
        slack: share of a bound by which it may be passed before an episode ends.
        rate_limit: on the body rate in rad/s, infinite where there is none.
    """

    def one(key: jax.Array) -> tuple[dict[str, Any], ...]:
        state = initial_state.draw(task.vehicle, task.target, key)
        gained = _speed_gained(task.vehicle, state.attitude, rate_limit)
        state = dataclasses.replace(state, velocity=(gained, jnp.zeros(()), jnp.zeros(())))
        here = situation(task.reference(0), state, jnp.zeros(4))
        ends = task.termination.items()
        return (
            {name: end.measure(here) for name, end in ends},
            {name: end.margin(here) + slack * end.slack >= 0 for name, end in ends},
        )

    return jax.vmap(one)(jax.random.split(jax.random.key(0), STARTS))


def _speed_gained(vehicle: Vehicle, attitude: Components, rate_limit: Any) -> Any:
    """The horizontal speed in m/s that a start at rest gains before it is level.

        v = g sin(tilt) t0 + g sin(tilt)^2 / (2 w)

    For t0, one control period and the action latency, nothing answers; then the vehicle turns level at the bound on
    its body rate w, with a thrust that just leaves no acceleration along itself, g cos(tilt). A larger tilt than a
    right angle counts as one.
    """
    steep = jnp.sin(jnp.minimum(jnp.arccos(jnp.clip(rotation.vertical_axis(attitude)[2], -1, 1)), math.pi / 2))
    waits = (1 + vehicle.action_latency_steps) * vehicle.control_period
    return vehicle.gravity * (steep * waits + steep**2 / (2 * rate_limit))


def _message(name: str, end: Any, measures: Any, where: str, kept: float) -> str:
    text, factor = WORDS[end.quantity]
    low, high = factor * float(np.min(measures)), factor * float(np.max(measures))
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
