"""Flying: the recorded flights of a controller on a task, in any simulator."""

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np

from flytune.control.controller import Controller
from flytune.control.policy import check_actions_fit
from flytune.control.schedule import ScheduledPolicy, settings_along, shown_setting
from flytune.errors import BadInput
from flytune.evaluation.flights import Flights
from flytune.evaluation.margins import largest_speed_bound, recorded_margins
from flytune.evaluation.trials import begin_trials, rollout_trials, trial_keys
from flytune.physics.vehicle import Vehicle
from flytune.runs.find import FoundController
from flytune.simulation.simulator import WIDTHS, Simulator, VehicleStates
from flytune.simulation.simulators import make_simulator
from flytune.task.initial_state import EVALUATION_INITIAL_STATES, InitialState
from flytune.task.met import as_met
from flytune.task.observation import SIZE
from flytune.task.target import sampled
from flytune.task.task import Task

InitialConditions = Literal["clear", "paper"]


def fly(
    controller: Controller | FoundController,
    task: Task,
    *,
    trials: int = 100,
    seed: int = 1,
    initial_conditions: InitialConditions | InitialState = "clear",
    duration: float | None = None,
    name: str = "",
    changes: Mapping[str, Any] | None = None,
    simulator: str | Callable[[Vehicle, int], Simulator] = "flytune",
    simulator_options: Mapping[str, Any] | None = None,
) -> Flights:
    """The trajectories of a controller over many trials, from rest, on noisy observations (paper R19).

    The initial state and the noise of a trial depend on (seed, trial, step) alone, so that controllers and simulators
    can be compared on equal terms. Trials run to their end whether or not a termination is crossed.

    Args:
        controller: a controller, or the result of `find_controller`.
        task: the task, with its vehicle.
        trials: number of trials, 1 or more.
        seed: of initial states and noise.
        initial_conditions: `clear` (z0 >= 0.1 m), `paper` (exactly as printed), or a distribution of your own.
        duration: of a trial in s, more than 0.5; the task's own where None.
        name: the controller's name in the flights.
        changes: field path -> its true value, of the vehicle or the noise, where the controller meets something else
            than `task`, which is what it was told; see `task.met`.
        simulator: one of `flytune`, `pybullet`, `mujoco`; or a function that makes another one, from a vehicle and the
            number of trials.
        simulator_options: of that simulator, see `make_simulator`.

    Raises:
        BadInput: an argument out of range, or a simulator that is not installed.
        Diverged: the controller answered a finite observation with an action that is not finite.
    """
    made_for, changes = "", dict(changes or {})
    if isinstance(controller, FoundController):
        controller, name, made_for = controller.controller, name or controller.name, controller.made_for(task)
    family, task = task, task.at({name: values[0] for name, values in settings_along(controller, task, 1).items()})
    duration = task.duration if duration is None else duration
    own = isinstance(initial_conditions, InitialState)
    starts_name = "own" if own else initial_conditions
    _check_arguments(trials, seed, "clear" if own else starts_name, duration)
    _check_controller(controller)
    check_actions_fit(getattr(getattr(controller, "policy", controller), "about", {}), task.vehicle, name)
    period = task.vehicle.control_period
    if isinstance(controller, ScheduledPolicy):
        controller = dataclasses.replace(controller, control_period=period)
    steps = round(duration / period)
    initial_state = initial_conditions if own else EVALUATION_INITIAL_STATES[initial_conditions]
    if problem := initial_state.problem() or initial_state.problem_around(task.target):
        raise BadInput(f"starts {starts_name}: {problem}")
    if problem := task.problem_of_path(duration):
        raise BadInput(problem)
    task = as_met(dataclasses.replace(task, initial_state=initial_state), changes)
    starts, noise_keys = begin_trials(task, trial_keys(seed, trials))
    simulator_name, made = _made(simulator, task.vehicle, trials, simulator_options)
    try:
        record = rollout_trials(made, controller, task, starts, noise_keys, steps, name)
    finally:
        made.close()
    states, actions = np.asarray(record.states), np.asarray(record.actions)
    along = settings_along(controller, family, steps + 1) if isinstance(controller, ScheduledPolicy) else {}
    trajectories = VehicleStates.from_rows(np.ascontiguousarray(states.transpose(2, 0, 1)))
    time = np.arange(steps + 1) * period
    place, yaw = sampled(task.target, time)
    return Flights(
        time=time,
        **{field: getattr(trajectories, field) for field in WIDTHS},
        action=np.ascontiguousarray(actions.transpose(2, 0, 1)),
        crashed=np.asarray(record.crashed),
        margins=recorded_margins(family if along else task, along, states, actions),
        target_position=place,
        target_yaw=yaw,
        speed_bound=largest_speed_bound(family, along) if along else task.speed_bound,
        name=name,
        task=task.name,
        vehicle=task.vehicle.name,
        simulator=simulator_name,
        seed=seed,
        initial_conditions=starts_name,
        dial=shown_setting(controller),
        made_for=made_for,
        changes=changes,
    )


def _made(
    simulator: str | Callable[[Vehicle, int], Simulator],
    vehicle: Vehicle,
    trials: int,
    options: Mapping[str, Any] | None,
) -> tuple[str, Simulator]:
    """The name of a simulator, and the simulator for so many vehicles.

    Raises:
        BadInput: it is unknown or not installed, or options are given to one of the user's own.
    """
    if isinstance(simulator, str):
        return simulator, make_simulator(simulator, vehicle, trials, options)
    if options:
        raise BadInput("simulator_options: are not allowed with a simulator of your own. Give them to its function.")
    return getattr(simulator, "__name__", "custom"), simulator(vehicle, trials)


def _check_arguments(trials: int, seed: int, initial_conditions: str, duration: float) -> None:
    """Refuse what is out of range.

    Raises:
        BadInput: the argument, and what is allowed.
    """
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


def _check_controller(controller: Any) -> None:
    """Refuse a controller that the rollout cannot fly, before anything is compiled.

    Raises:
        BadInput: it is no JAX pytree, lacks a function, or its action or memory has another shape.
    """
    name = type(controller).__name__
    if not isinstance(controller, Controller):
        raise BadInput(f"controller: {name} is not allowed. Allowed: an object with `initial_memory()` and `act(...)`.")
    if any(leaf is controller for leaf in jax.tree.leaves(controller)):
        raise BadInput(
            f"controller: {name} is no JAX pytree. Decorate its class with jax.tree_util.register_dataclass, or see "
            "examples/own_controller.py."
        )
    before = jax.eval_shape(lambda each: each.initial_memory(), controller)
    seen = jax.ShapeDtypeStruct((SIZE,), np.float32)
    after, action = jax.eval_shape(lambda each, *given: each.act(*given), controller, before, seen)
    if jnp.shape(action) != (4,):
        raise BadInput(f"controller: {name}.act gives an action of shape {jnp.shape(action)}. Allowed: (4,).")
    kinds = [jax.tree.map(lambda leaf: (leaf.shape, leaf.dtype), memory) for memory in (before, after)]
    if kinds[0] != kinds[1]:
        raise BadInput(
            f"controller: {name}.act gives the memory {kinds[1]}. Allowed: as in initial_memory, {kinds[0]}."
        )
