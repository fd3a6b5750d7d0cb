"""The margins of recorded flights, also of flights in which dials are turned."""

from collections.abc import Mapping

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from flytune.kernels.programs import program
from flytune.simulation.environment import margins_along
from flytune.simulation.simulator import state_from
from flytune.task.task import Task

LOOKED_UP = 50  # settings of a flight at which its speed bound is looked up
CHUNK = 100  # samples that one compiled program works on, so that flights of any duration share it


def recorded_margins(
    task: Task,
    settings: Mapping[str, np.ndarray],
    states: Float[np.ndarray, "samples 17 N"],
    actions: Float[np.ndarray, "samples 4 N"],
) -> dict[str, Float[np.ndarray, "N samples"]]:
    """The margin of each termination at every sample of N flights.

    Args:
        task: the task that was flown; where its dials were turned in flight, the task with its dials.
        settings: of these dials, the value at each sample; empty where none was turned.
        states: the true states, see `state_numbers`.
        actions: the action before each state.
    """
    changes, samples = np.diff(actions, axis=0, prepend=actions[:1]), len(states)
    parts = []
    for first in range(0, samples, CHUNK):
        rows = np.minimum(np.arange(first, first + CHUNK), samples - 1)
        here = {name: np.asarray(values[rows], np.float32) for name, values in settings.items()}
        parts.append(_margins(task, here, states[rows], changes[rows], rows.astype(np.int32)))
    return {name: np.concatenate([np.asarray(part[name]) for part in parts], axis=-1)[:, :samples] for name in parts[0]}


def largest_speed_bound(task: Task, settings: Mapping[str, np.ndarray]) -> float | None:
    """The largest speed bound in m/s of a flight in which the dials of the task have these settings.

    None where a setting has no bound. The bound is looked up at the settings that the flight passes, not between them.
    """
    passed = np.unique(np.stack(list(settings.values()), axis=-1), axis=0)
    shown = passed[np.linspace(0, len(passed) - 1, min(len(passed), LOOKED_UP)).astype(int)]
    bounds = [task.at(dict(zip(settings, map(float, values), strict=True))).speed_bound for values in shown]
    return None if None in bounds else max(bound for bound in bounds if bound is not None)


@program()
def _margins(
    task: Task, settings: dict[str, jax.Array], states: jax.Array, changes: jax.Array, steps: jax.Array
) -> dict[str, jax.Array]:
    """The margins [N, samples] of states [samples, 17, N] under changes of the action [samples, 4, N]."""

    def one(numbers: jax.Array, changes: jax.Array) -> dict[str, jax.Array]:
        none_pending = jnp.zeros((len(changes), task.vehicle.action_latency_steps, 4))
        return margins_along(task, settings, state_from(numbers.T, none_pending), changes, steps)

    return jax.vmap(one, in_axes=-1)(states, changes)
