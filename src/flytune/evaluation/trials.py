"""Trials: the trajectories of a controller from given states, on the device or on the host."""

import dataclasses
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from flytune.errors import Diverged
from flytune.evaluation.margins import CHUNK
from flytune.kernels.programs import program
from flytune.physics.dynamics import no_pending_actions
from flytune.physics.rotors import hover_action
from flytune.simulation.environment import Episode, begin, hold, is_crashed
from flytune.simulation.host import HostEnvironment, ravel
from flytune.simulation.rollout import Draw, rollout
from flytune.simulation.simulator import Simulator, state_from, state_numbers
from flytune.task.observation import SIZE, draw_noise
from flytune.task.task import Task

ACTION = slice(SIZE - 4, SIZE)  # of an observation: the last action, which carries no noise


class Record(NamedTuple):
    """Trajectories of N trials at samples 0 to T; a crashed trial holds its last sample."""

    states: Any  # [T + 1, 17, N]
    actions: Any  # [T + 1, 4, N], clipped; sample 0 is hover
    crashed: Any  # [N] bool


def rollout_trials(
    simulator: Simulator, controller: Any, task: Task, starts: Any, noise_keys: Any, steps: int, name: str
) -> Record:
    """The trajectories of trials: as one compiled loop where the simulator allows it.

    Args:
        simulator: of N vehicles.
        controller: with `initial_memory` and `act`.
        task: without dials.
        starts: the states [17, N] in which the trials begin.
        noise_keys: [N], of the noise of the observations.
        steps: control steps of each trial.
        name: of the controller, for a message.

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
def begin_trials(task: Task, keys: jax.Array) -> tuple[jax.Array, jax.Array]:
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
