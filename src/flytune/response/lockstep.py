"""Flying in a world that JAX cannot look into: pilot and simulator take turns, all trials side by side."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from flytune.bridges.world import Body, World
from flytune.physics.dynamics import State, hovering
from flytune.response.trial import begin, decide, is_lost, margins_along, not_finite
from flytune.task.initial_state import InitialState
from flytune.task.task import Task

MOVING = ("position", "attitude", "velocity", "body_rate", "rotor_speed_rpm")


def fly_in_world(
    world: World, controller: Any, task: Task, starts: InitialState, keys: jax.Array, steps: int, who: str
) -> tuple[State, np.ndarray, dict[str, np.ndarray], np.ndarray]:
    """States, actions and margins at samples 0 to `steps` of each trial, and which trials crashed.

    Start, noise, observation and what counts as a crash are those of `fly` in flytune's own world. A vehicle that has
    crashed is parked at the target for the rest of its trial, where the simulator has no trouble with it.

    Raises:
        Diverged: the controller answered with an action that is not finite.
    """
    controller, task = jax.device_put((controller, task))  # once, not at every step
    trials = len(keys)
    state, noise_keys = _begin_all(task, starts, keys)
    parked = _bodies(_parked(task, trials))
    memory = jax.tree.map(lambda part: jnp.broadcast_to(part, (trials, *jnp.shape(part))), controller.initial_memory())
    action, crashed = np.zeros((trials, 4), np.float32), np.array(_lost(task, state))
    now = _bodies(state)
    world.place(now)
    if crashed.any():
        _park(world, parked, crashed)
    record, actions = [now], [action]
    for index in range(steps):
        memory, wanted, given, finite = _decide_all(
            controller, task, noise_keys, index, _state(task, now), action, memory
        )
        if not np.all(finite):
            trial = int(np.argmin(finite))
            raise not_finite(who, given[trial], trial, index)
        world.advance(np.where(crashed[:, None], 0.0, wanted))
        moved = world.body()
        lost = ~crashed & np.asarray(_lost(task, _state(task, moved)))
        if lost.any():
            crashed = crashed | lost
            _park(world, parked, lost)
        now = Body(**{name: _kept(crashed, getattr(now, name), getattr(moved, name)) for name in MOVING})
        action = _kept(crashed, action, np.asarray(wanted))
        record.append(now)
        actions.append(action)
    flown = Body(**{name: np.stack([getattr(body, name) for body in record], axis=1) for name in MOVING})
    states, flown_actions = _state(task, flown), np.stack(actions, axis=1)
    return states, flown_actions, _margins_all(task, states, flown_actions), crashed


@jax.jit
def _begin_all(task: Task, starts: InitialState, keys: jax.Array) -> tuple[State, jax.Array]:
    return jax.vmap(lambda key: begin(task, starts, key))(keys)


@jax.jit
def _decide_all(
    controller: Any, task: Task, noise_keys: jax.Array, index: Any, state: State, last_action: Any, memory: Any
) -> Any:
    def one(noise_key: jax.Array, state: State, last_action: jax.Array, memory: Any) -> Any:
        return decide(controller, task, noise_key, index, state, last_action, memory)

    return jax.vmap(one)(noise_keys, state, last_action, memory)


@jax.jit
def _lost(task: Task, state: State) -> jax.Array:
    return jax.vmap(lambda one: is_lost(task, one))(state)


@jax.jit
def _margins_all(task: Task, states: State, actions: Any) -> dict[str, jax.Array]:
    return jax.vmap(lambda s, a: margins_along(task, s, a))(states, actions)


def _parked(task: Task, trials: int) -> State:
    state = hovering(task.vehicle, task.target.position)
    return jax.tree.map(lambda part: jnp.broadcast_to(part, (trials, *part.shape)), state)


def _park(world: World, parked: Body, which: np.ndarray) -> None:
    world.place(Body(**{name: getattr(parked, name)[which] for name in MOVING}), np.flatnonzero(which))


def _bodies(state: State) -> Body:
    return Body(**{name: np.stack([np.asarray(part) for part in getattr(state, name)], axis=-1) for name in MOVING})


def _state(task: Task, body: Body) -> State:
    """Bodies as the state a pilot is shown, in float32; what is under way in the actuators stays in the world."""
    parts = {name: tuple(np.moveaxis(getattr(body, name).astype(np.float32), -1, 0)) for name in MOVING}
    pending = jnp.zeros((*body.position.shape[:-1], task.vehicle.action_latency_steps, 4))
    return State(**parts, pending_actions=pending)


def _kept(crashed: np.ndarray, old: np.ndarray, new: np.ndarray) -> np.ndarray:
    return np.where(crashed[:, None], old, new).astype(np.float32)
