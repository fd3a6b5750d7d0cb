"""Flying: a controller, a task and a set of starts become recorded flights."""

from functools import partial
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np

from flytune.control.controller import Controller
from flytune.errors import BadInput, Diverged
from flytune.physics import dynamics
from flytune.physics.dynamics import CONTROL_PERIOD, State
from flytune.physics.rotation import safe_norm
from flytune.response.flights import CRASH_DISTANCE, Flights
from flytune.task.initial_state import EVALUATION_STARTS, InitialState
from flytune.task.observation import draw_noise, observe
from flytune.task.situation import position_error, situation
from flytune.task.task import Task
from flytune.task.termination import margins

Starts = Literal["clear", "paper"]


def fly(
    controller: Controller,
    task: Task,
    *,
    trials: int = 100,
    seed: int = 1,
    starts: Starts = "clear",
    duration: float | None = None,
    who: str = "",
) -> Flights:
    """The trajectories of a controller over many trials, from rest, on noisy observations (paper R19).

    Start and noise of a trial depend on (seed, trial, step) alone, so controllers can be compared on equal terms.
    Trials run to their end whether or not a termination is crossed.

    Args:
        controller: the pilot.
        task: what it is asked to do, and with which vehicle.
        trials: how many, 1 or more.
        seed: of starts and noise.
        starts: `clear` (z0 >= 0.1 m) or `paper` (exactly as printed).
        duration: of a trial in s, more than 0.5; the task's own where None.
        who: the pilot's name, for the record.

    Raises:
        BadInput: an argument out of range.
        Diverged: the controller answered a finite observation with an action that is not finite.
    """
    duration = task.duration if duration is None else duration
    if not 1 <= trials <= 100_000:
        raise BadInput(f"trials: {trials} is not allowed. Allowed: a whole number, 1 to 100000.")
    if not (np.isfinite(duration) and 0.5 < duration <= 3600):
        raise BadInput(f"duration: {duration} is not allowed. Allowed: above 0.5 to 3600 s.")
    if starts not in EVALUATION_STARTS:
        raise BadInput(f"starts: {starts!r} is not allowed. Allowed: {', '.join(EVALUATION_STARTS)}.")
    if not 0 <= seed < 2**32:
        raise BadInput(f"seed: {seed} is not allowed. Allowed: a whole number, 0 to {2**32 - 1}.")
    steps = round(duration / CONTROL_PERIOD)
    keys = jax.vmap(partial(jax.random.fold_in, jax.random.key(seed)))(jnp.arange(trials))
    record = _fly_all(controller, task, EVALUATION_STARTS[starts], keys, steps)
    states, actions, left, crashed, given, finite = jax.tree.map(np.asarray, record)
    if not np.all(finite):
        trial, step = np.argwhere(~finite)[0]
        raise Diverged(
            f"{who or 'controller'}: action {given[trial, step]} is not finite in trial {trial} "
            f"at {step * CONTROL_PERIOD:.2f} s, on a finite observation."
        )
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
        who=who,
        task=task.name,
        vehicle=task.vehicle.name,
        world="flytune",
        seed=seed,
        starts=starts,
    )


@partial(jax.jit, static_argnames="steps")
def _fly_all(controller: Any, task: Task, starts: InitialState, keys: jax.Array, steps: int) -> Any:
    return jax.vmap(lambda key: _fly_one(controller, task, starts, key, steps))(keys)


def _fly_one(controller: Any, task: Task, starts: InitialState, key: jax.Array, steps: int) -> Any:
    """States, actions, margins at samples 0 to `steps`; crashed or not; the actions as given, and which were finite."""
    start_key, noise_key = jax.random.split(key)
    start = starts.draw(task.vehicle, start_key)
    rest = jnp.zeros(4)

    def advance(carry: Any, index: jax.Array) -> Any:
        state, last_action, memory, crashed = carry
        normal = draw_noise(jax.random.fold_in(noise_key, index))
        seen = observe(task.target, task.noise, state, last_action, normal)
        memory, action = controller.act(memory, seen)
        finite = jnp.all(jnp.isfinite(action)) | ~jnp.all(jnp.isfinite(seen))
        given, action = action, jnp.clip(action, -1.0, 1.0)
        moved = dynamics.step(task.vehicle, state, action)
        crashed = crashed | _is_lost(task, moved)
        kept = jax.tree.map(lambda new, old: jnp.where(crashed, old, new), (moved, action), (state, last_action))
        return (*kept, memory, crashed), (*kept, given, finite)

    carry = (start, rest, controller.initial_memory(), _is_lost(task, start))
    (_, _, _, crashed), (states, actions, given, finite) = jax.lax.scan(advance, carry, jnp.arange(steps))
    states = jax.tree.map(lambda first, later: jnp.concatenate([first[None], later]), start, states)
    actions = jnp.concatenate([rest[None], actions])
    changes = jnp.diff(actions, axis=0, prepend=rest[None])
    left = jax.vmap(lambda s, change: margins(task.termination, situation(task.target, s, change)))(states, changes)
    return states, actions, left, crashed, given, finite


def _is_lost(task: Task, state: State) -> jax.Array:
    distance = safe_norm(position_error(task.target, state.position))
    body = jnp.stack([*state.position, *state.attitude, *state.velocity, *state.body_rate])
    return ~((distance <= CRASH_DISTANCE) & jnp.all(jnp.isfinite(body)))
