"""Flying: a controller, a task and a set of starts become recorded flights."""

from collections.abc import Mapping
from functools import partial
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np

from flytune.control.controller import Controller
from flytune.errors import BadInput
from flytune.evaluation.flights import Flights
from flytune.evaluation.lockstep import fly_in_simulator
from flytune.evaluation.trial import begin, decide, is_lost, margins_along, not_finite, trial_keys
from flytune.physics import dynamics
from flytune.physics.dynamics import CONTROL_PERIOD, State
from flytune.simulation.simulators import make_simulator
from flytune.task.initial_state import EVALUATION_INITIAL_STATES, InitialState
from flytune.task.task import Task

InitialConditions = Literal["clear", "paper"]


def fly(
    controller: Controller,
    task: Task,
    *,
    trials: int = 100,
    seed: int = 1,
    initial_conditions: InitialConditions = "clear",
    duration: float | None = None,
    name: str = "",
    simulator: str = "flytune",
    simulator_options: Mapping[str, Any] | None = None,
) -> Flights:
    """The trajectories of a controller over many trials, from rest, on noisy observations (paper R19).

    Start and noise of a trial depend on (seed, trial, step) alone, so controllers, and worlds, can be compared on
    equal terms.
    Trials run to their end whether or not a termination is crossed.

    Args:
        controller: the controller.
        task: what it is asked to do, and with which vehicle.
        trials: how many, 1 or more.
        seed: of starts and noise.
        starts: `clear` (z0 >= 0.1 m) or `paper` (exactly as printed).
        duration: of a trial in s, more than 0.5; the task's own where None.
        who: the controller's name, for the record.
        world: the simulator, one of `flytune`, `pybullet`, `mujoco`.
        world_options: of that simulator, see `make_world`.

    Raises:
        BadInput: an argument out of range, or a simulator that is not installed.
        Diverged: the controller answered a finite observation with an action that is not finite.
    """
    duration = task.duration if duration is None else duration
    if not 1 <= trials <= 100_000:
        raise BadInput(f"trials: {trials} is not allowed. Allowed: a whole number, 1 to 100000.")
    if not (np.isfinite(duration) and 0.5 < duration <= 3600):
        raise BadInput(f"duration: {duration} is not allowed. Allowed: above 0.5 to 3600 s.")
    if initial_conditions not in EVALUATION_INITIAL_STATES:
        raise BadInput(
            f"starts: {initial_conditions!r} is not allowed. Allowed: {', '.join(EVALUATION_INITIAL_STATES)}."
        )
    if not 0 <= seed < 2**32:
        raise BadInput(f"seed: {seed} is not allowed. Allowed: a whole number, 0 to {2**32 - 1}.")
    steps = round(duration / CONTROL_PERIOD)
    drawn, keys = EVALUATION_INITIAL_STATES[initial_conditions], trial_keys(seed, trials)
    if simulator == "flytune" and not simulator_options:
        record = _fly_at_once(controller, task, drawn, keys, steps, name)
    else:
        elsewhere = make_simulator(simulator, task.vehicle, trials, simulator_options)
        try:
            record = fly_in_simulator(elsewhere, controller, task, drawn, keys, steps, name)
        finally:
            elsewhere.close()
    states, actions, left, crashed = jax.tree.map(np.asarray, record)
    return Flights(
        time=np.arange(steps + 1) * CONTROL_PERIOD,
        position=np.stack(states.position, axis=-1),
        attitude=np.stack(states.attitude, axis=-1),
        velocity=np.stack(states.velocity, axis=-1),
        body_rate=np.stack(states.body_rate, axis=-1),
        rotor_speed_rpm=np.stack(states.rotor_speed_rpm, axis=-1),
        action=actions,
        crashed=crashed,
        margins=left,
        target_position=np.asarray(task.target.position),
        target_yaw=float(task.target.yaw),
        speed_bound=task.speed_bound,
        name=name,
        task=task.name,
        vehicle=task.vehicle.name,
        simulator=simulator,
        seed=seed,
        initial_conditions=initial_conditions,
    )


def _fly_at_once(
    controller: Any, task: Task, initial_conditions: InitialState, keys: jax.Array, steps: int, name: str
) -> tuple[State, Any, dict[str, Any], Any]:
    """The same as `fly_in_world`, in flytune's own world: one compiled program."""
    *record, given, finite = _fly_all(controller, task, initial_conditions, keys, steps)
    if not np.all(finite):
        trial, step = np.argwhere(~np.asarray(finite))[0]
        raise not_finite(name, given[trial, step], trial, step)
    return tuple(record)


@partial(jax.jit, static_argnames="steps")
def _fly_all(controller: Any, task: Task, initial_conditions: InitialState, keys: jax.Array, steps: int) -> Any:
    return jax.vmap(lambda key: _fly_one(controller, task, initial_conditions, key, steps))(keys)


def _fly_one(controller: Any, task: Task, initial_conditions: InitialState, key: jax.Array, steps: int) -> Any:
    """States, actions, margins at samples 0 to `steps`; crashed or not; the actions as given, and which were finite."""
    start, noise_key = begin(task, initial_conditions, key)
    rest = jnp.zeros(4)

    def advance(carry: Any, index: jax.Array) -> Any:
        state, last_action, memory, crashed = carry
        memory, action, given, finite = decide(controller, task, noise_key, index, state, last_action, memory)
        moved = dynamics.step(task.vehicle, state, action)
        crashed = crashed | is_lost(task, moved)
        kept = jax.tree.map(lambda new, old: jnp.where(crashed, old, new), (moved, action), (state, last_action))
        return (*kept, memory, crashed), (*kept, given, finite)

    carry = (start, rest, controller.initial_memory(), is_lost(task, start))
    (_, _, _, crashed), (states, actions, given, finite) = jax.lax.scan(advance, carry, jnp.arange(steps))
    states = jax.tree.map(lambda first, later: jnp.concatenate([first[None], later]), start, states)
    actions = jnp.concatenate([rest[None], actions])
    return states, actions, margins_along(task, states, actions), crashed, given, finite
