"""Flying: the recorded flights of a controller on a task, in any simulator."""

import dataclasses
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from flytune.control.controller import Controller
from flytune.control.policy import check_actions_fit
from flytune.control.schedule import ScheduledPolicy, settings_along, shown_setting
from flytune.errors import BadInput, Diverged
from flytune.evaluation.flights import Flights
from flytune.evaluation.margins import CHUNK, largest_speed_bound, recorded_margins
from flytune.kernels.programs import program
from flytune.physics.dynamics import no_pending_actions
from flytune.physics.rotors import hover_action
from flytune.physics.vehicle import Vehicle
from flytune.runs.find import FoundController
from flytune.simulation.environment import Episode, begin, hold, is_crashed
from flytune.simulation.host import HostEnvironment, ravel
from flytune.simulation.rollout import Draw, rollout
from flytune.simulation.simulator import WIDTHS, Simulator, VehicleStates, state_from, state_numbers
from flytune.simulation.simulators import make_simulator
from flytune.task.initial_state import EVALUATION_INITIAL_STATES, InitialState
from flytune.task.met import as_met
from flytune.task.observation import SIZE, draw_noise
from flytune.task.target import sampled
from flytune.task.task import Task

ACTION = slice(SIZE - 4, SIZE)  # of an observation: the last action, which carries no noise
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
    steps = round(duration / period)
    initial_state = initial_conditions if own else EVALUATION_INITIAL_STATES[initial_conditions]
    if problem := initial_state.problem() or initial_state.problem_around(task.target):
        raise BadInput(f"starts {starts_name}: {problem}")
    if problem := task.problem_of_path(duration):
        raise BadInput(problem)
    task = as_met(dataclasses.replace(task, initial_state=initial_state), changes)
    starts, noise_keys = _begin(task, trial_keys(seed, trials))
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


class Record(NamedTuple):
    """Trajectories of N trials at samples 0 to T; a crashed trial holds its last sample."""

    states: Any  # [T + 1, 17, N]
    actions: Any  # [T + 1, 4, N], clipped; sample 0 is hover
    crashed: Any  # [N] bool


def rollout_trials(
    simulator: Simulator, controller: Any, task: Task, starts: Any, noise_keys: Any, steps: int, name: str
) -> Record:
    """The trajectories of trials that begin in states [17, N]: as one compiled loop where the simulator allows it.

    Raises:
        Diverged: the controller answered a finite observation with an action that is not finite.
    """
    if simulator.physics is None:
        return _rollout_on_host(simulator, controller, task, starts, noise_keys, steps, name)
    record, given, finite = _rollout_on_device(simulator.physics, controller, task, starts, noise_keys, steps)
    if not np.all(finite):
        trial, step = np.argwhere(~np.asarray(finite).T)[0]
        raise _not_finite(controller, name, given[step, trial], trial, step * task.vehicle.control_period)
    return record


def _rollout_on_host(
    simulator: Simulator, controller: Any, task: Task, starts: Any, noise_keys: Any, steps: int, name: str
) -> Record:
    """The trajectories where controller and simulator take turns."""
    trials = len(noise_keys)
    controller, task = jax.device_put((controller, task))  # once, not at every step
    environment = HostEnvironment(task, simulator, trials, ending="hold")
    seen = environment.start(_episodes(task, starts), _noise(noise_keys, 0))
    memory = _initial_memory(controller, trials)
    states, actions = [environment.states.T], [seen[:, ACTION].T]
    crashed = np.zeros(trials, bool)
    for index in range(steps):
        memory, action, given, finite = _decide(controller, memory, seen)
        if not np.all(finite):
            trial = int(np.argmin(finite))
            raise _not_finite(controller, name, given[trial], trial, index * task.vehicle.control_period)
        moved = environment.step(np.asarray(action), _noise(noise_keys, index + 1))
        seen, crashed = environment.observation, moved.crashed
        states.append(environment.states.T)
        actions.append(seen[:, ACTION].T)
    return Record(np.stack(states), np.stack(actions), crashed)


def trial_keys(seed: int, trials: int) -> jax.Array:
    """The random key of each trial, from the seed and the trial's number alone."""
    return _trial_keys(np.uint32(seed), trials)


@program(static=["trials"])
def _trial_keys(seed: jax.Array, trials: int) -> jax.Array:
    return jax.vmap(partial(jax.random.fold_in, jax.random.key(seed)))(jnp.arange(trials))


@program()
def _begin(task: Task, keys: jax.Array) -> tuple[jax.Array, jax.Array]:
    """The states [17, N] in which trials begin, and the keys of their noise."""

    def one(key: jax.Array) -> tuple[jax.Array, jax.Array]:
        start_key, noise_key = jax.random.split(key)
        return state_numbers(task.initial_state.draw(task.vehicle, task.target, start_key)), noise_key

    return jax.vmap(one, out_axes=(-1, 0))(keys)


@program()
def _episodes(task: Task, starts: jax.Array) -> jax.Array:
    """The episodes [K, N] that begin in states [17, N]; one that begins crashed is held from the start."""
    return ravel(_started(task, starts))


def _started(task: Task, starts: jax.Array) -> Episode:
    def one(numbers: jax.Array) -> Episode:
        state = state_from(numbers, no_pending_actions(task.vehicle))
        crashed = is_crashed(task, state, 0)
        episode = begin(task.vehicle, state)
        return dataclasses.replace(episode, steps=jnp.where(crashed, -1, episode.steps))

    return jax.vmap(one, in_axes=-1, out_axes=-1)(starts)


def _rollout_on_device(
    physics: Any, controller: Any, task: Task, starts: Any, noise_keys: Any, steps: int
) -> tuple[Record, np.ndarray, np.ndarray]:
    """The record, the actions as given [T, N, 4], and which of them are finite [T, N].

    All parts of `CHUNK` steps share one compiled program, so that another duration compiles nothing.
    """
    episodes, memory = _start(controller, task, starts)
    parts = []
    for first in range(0, steps, CHUNK):
        number = min(CHUNK, steps - first)
        episodes, memory, *part = _steps_on_device(
            physics, controller, task, episodes, memory, noise_keys, np.int32(first), number
        )
        parts.append([np.asarray(each) for each in part])
    states, actions, given, finite = (np.concatenate(each) for each in zip(*parts, strict=True))
    states = np.concatenate([np.asarray(starts)[None], states])
    actions = np.concatenate([np.full_like(actions[:1], float(hover_action(task.vehicle))), actions])
    return Record(states, actions, np.asarray(episodes.steps) < 0), given, finite


@program()
def _start(controller: Any, task: Task, starts: jax.Array) -> tuple[Episode, Any]:
    """The episodes that begin in states [17, N], and the controller's memory for each."""
    return _started(task, starts), _initial_memory(controller, starts.shape[-1])


@program(static=["physics", "steps"])
def _steps_on_device(
    physics: Any,
    controller: Any,
    task: Task,
    episodes: Episode,
    memory: Any,
    noise_keys: jax.Array,
    first: Any,
    steps: int,
) -> tuple[Any, ...]:
    """The episodes and the memory after some steps from step `first` on; and [steps, ...] states, actions, actions as
    given, and which of them are finite.
    """  # fmt: skip

    def decide(memory: Any, seen: jax.Array, drawn: Any, episodes: Episode) -> Any:
        memory, action, given, finite = _decide(controller, memory, seen)
        return memory, action, (given, finite)

    (episodes, memory), step = rollout(
        task,
        decide,
        (episodes, memory),
        first + jnp.arange(steps),
        ending=hold,
        record=lambda task, after, moved, outcome: (state_numbers(after.state), after.last_action),
        draw=lambda index: Draw(noise=_noise(noise_keys, index)),
        physics=physics,
    )
    return episodes, memory, *step.record, *step.notes


@program()
def _noise(keys: jax.Array, index: Any) -> jax.Array:
    """The noise [13, N] of every trial's observation at sample `index`."""
    return jax.vmap(lambda key: draw_noise(jax.random.fold_in(key, index)), out_axes=-1)(keys)


def _initial_memory(controller: Any, trials: int) -> Any:
    return jax.tree.map(lambda part: jnp.broadcast_to(part, (trials, *jnp.shape(part))), controller.initial_memory())


@program()
def _decide(controller: Any, memory: Any, seen: jax.Array) -> tuple[Any, jax.Array, jax.Array, jax.Array]:
    """The controller's memory, actions clipped [N, 4], actions as given, and which of them are finite [N].

    An action that is not finite counts against the controller only where its observation is finite.
    """
    memory, given = jax.vmap(controller.act)(memory, seen)
    finite = jnp.all(jnp.isfinite(given), axis=-1) | ~jnp.all(jnp.isfinite(seen), axis=-1)
    return memory, jnp.clip(given, -1.0, 1.0), given, finite


def _not_finite(controller: Any, name: str, action: Any, trial: Any, time: float) -> Diverged:
    if failure := getattr(controller, "failure", None):  # of an ONNX model that was stopped in flight
        return Diverged(f"{name or 'controller'}: {failure}")
    return Diverged(
        f"{name or 'controller'}: action {action} is not finite in trial {trial} "
        f"at {time:.2f} s, on a finite observation."
    )
