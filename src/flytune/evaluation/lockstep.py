"""Flying in a world that JAX cannot look into: controller and simulator take turns, all trials side by side."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from flytune.evaluation.trial import begin, decide, is_lost, margins_along, not_finite
from flytune.physics.dynamics import State, hovering
from flytune.simulation.simulator import Simulator, VehicleStates
from flytune.task.initial_state import InitialState
from flytune.task.task import Task

WIDTHS = {"position": 3, "attitude": 4, "velocity": 3, "body_rate": 3, "rotor_speed_rpm": 4}  # of a row, in order


def fly_in_simulator(
    simulator: Simulator,
    controller: Any,
    task: Task,
    initial_conditions: InitialState,
    keys: jax.Array,
    steps: int,
    name: str,
) -> tuple[State, np.ndarray, dict[str, np.ndarray], np.ndarray]:
    """States, actions and margins at samples 0 to `steps` of each trial, and which trials crashed.

    Start, noise, observation and what counts as a crash are those of `fly` in flytune's own world. A vehicle that has
    crashed is parked at the target for the rest of its trial, where the simulator has no trouble with it.

    Raises:
        Diverged: the controller answered with an action that is not finite.
    """
    controller, task = jax.device_put((controller, task))  # once, not at every step
    trials = len(keys)
    first, parking, noise_keys = _begin_all(task, initial_conditions, keys)
    now, parked = np.asarray(first), np.asarray(parking)
    memory = jax.tree.map(lambda part: jnp.broadcast_to(part, (trials, *jnp.shape(part))), controller.initial_memory())
    action, crashed = np.zeros((trials, 4), np.float32), np.asarray(_lost(task, now))
    simulator.place(_bodies(np.where(crashed[:, None], parked, now)))
    record, actions = [now], [action]
    for index in range(steps):
        memory, wanted, given, finite = _decide_all(controller, task, noise_keys, index, now, action, memory)
        if not np.all(finite):
            trial = int(np.argmin(finite))
            raise not_finite(name, given[trial], trial, index)
        simulator.advance(np.where(crashed[:, None], 0.0, wanted))
        moved = _rows(simulator.body())
        lost = ~crashed & np.asarray(_lost(task, moved))
        if lost.any():
            crashed = crashed | lost
            simulator.place(_bodies(parked[lost]), np.flatnonzero(lost))
        now = np.where(crashed[:, None], now, moved)
        action = np.where(crashed[:, None], action, wanted)
        record.append(now)
        actions.append(action)
    flown, flown_actions = np.stack(record, axis=1), np.stack(actions, axis=1)
    return _state(task, flown), flown_actions, _margins_all(task, flown, flown_actions), crashed


@jax.jit
def _begin_all(task: Task, initial_conditions: InitialState, keys: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Rows of the starts and of vehicles parked at the target, and the keys of the noise."""
    states, noise_keys = jax.vmap(lambda key: begin(task, initial_conditions, key))(keys)
    parked = _row(hovering(task.vehicle, task.target.position))
    return _row(states), jnp.broadcast_to(parked, (len(keys), *parked.shape)), noise_keys


@jax.jit
def _decide_all(
    controller: Any, task: Task, noise_keys: jax.Array, index: Any, rows: Any, last_actions: Any, memories: Any
) -> Any:
    def one(noise_key: jax.Array, row: jax.Array, last_action: jax.Array, memory: Any) -> Any:
        return decide(controller, task, noise_key, index, _state(task, row), last_action, memory)

    return jax.vmap(one)(noise_keys, rows, last_actions, memories)


@jax.jit
def _lost(task: Task, rows: Any) -> jax.Array:
    return jax.vmap(lambda row: is_lost(task, _state(task, row)))(rows)


@jax.jit
def _margins_all(task: Task, rows: Any, actions: Any) -> dict[str, jax.Array]:
    return jax.vmap(lambda along, action: margins_along(task, _state(task, along), action))(rows, actions)


def _row(state: State) -> jax.Array:
    """A state as one row of numbers: one array goes to a compiled function far faster than seventeen."""
    return jnp.stack([part for name in WIDTHS for part in getattr(state, name)], axis=-1)


def _rows(body: VehicleStates) -> np.ndarray:
    """Bodies as rows, in the float32 a controller sees."""
    return np.concatenate([getattr(body, name) for name in WIDTHS], axis=-1).astype(np.float32)


def _state(task: Task, rows: Any) -> State:
    """Rows as the state a controller is shown; what is under way in the actuators stays in the world."""
    parts, first = {}, 0
    for name, width in WIDTHS.items():
        parts[name] = tuple(rows[..., index] for index in range(first, first + width))
        first += width
    return State(**parts, pending_actions=jnp.zeros((*rows.shape[:-1], task.vehicle.action_latency_steps, 4)))


def _bodies(rows: np.ndarray) -> VehicleStates:
    parts = np.split(rows, np.cumsum(list(WIDTHS.values()))[:-1], axis=-1)
    return VehicleStates(**dict(zip(WIDTHS, parts, strict=True)))
