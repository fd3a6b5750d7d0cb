"""What a trial is made of, whatever world it is flown in: its start, its noise, its controller's decisions, its margins."""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from flytune.errors import Diverged
from flytune.evaluation.flights import CRASH_DISTANCE
from flytune.physics.dynamics import CONTROL_PERIOD, State
from flytune.physics.rotation import safe_norm
from flytune.task.initial_state import InitialState
from flytune.task.observation import draw_noise, observe
from flytune.task.situation import position_error, situation
from flytune.task.task import Task
from flytune.task.termination import margins


def trial_keys(seed: int, trials: int) -> jax.Array:
    """The random key of each trial, from the seed and the trial's number alone."""
    return jax.vmap(partial(jax.random.fold_in, jax.random.key(seed)))(jnp.arange(trials))


def begin(task: Task, initial_conditions: InitialState, key: jax.Array) -> tuple[State, jax.Array]:
    """The start of a trial, and the key of its noise."""
    start_key, noise_key = jax.random.split(key)
    return initial_conditions.draw(task.vehicle, start_key), noise_key


def decide(
    controller: Any, task: Task, noise_key: jax.Array, index: Any, state: State, last_action: jax.Array, memory: Any
) -> tuple[Any, jax.Array, jax.Array, jax.Array]:
    """The controller's answer at sample `index`: memory, action flown, action as given, and whether that is finite.

    An action that is not finite is held against the controller only where what it saw was.
    """
    normal = draw_noise(jax.random.fold_in(noise_key, index))
    seen = observe(task.target, task.noise, state, last_action, normal)
    memory, given = controller.act(memory, seen)
    finite = jnp.all(jnp.isfinite(given)) | ~jnp.all(jnp.isfinite(seen))
    return memory, jnp.clip(given, -1.0, 1.0), given, finite


def is_lost(task: Task, state: State) -> jax.Array:
    """Whether a vehicle has crashed: it left the ball around its target, or stopped being finite."""
    distance = safe_norm(position_error(task.target, state.position))
    body = jnp.stack([*state.position, *state.attitude, *state.velocity, *state.body_rate])
    return ~((distance <= CRASH_DISTANCE) & jnp.all(jnp.isfinite(body)))


def margins_along(task: Task, states: State, actions: jax.Array) -> dict[str, jax.Array]:
    """The margin of each termination at every sample of one trial, first axis time."""
    changes = jnp.diff(actions, axis=0, prepend=jnp.zeros_like(actions[:1]))
    return jax.vmap(lambda s, change: margins(task.termination, situation(task.target, s, change)))(states, changes)


def not_finite(name: str, action: Any, trial: int, step: int) -> Diverged:
    """The complaint about a controller whose answer is not finite."""
    return Diverged(
        f"{name or 'controller'}: action {action} is not finite in trial {trial} "
        f"at {step * CONTROL_PERIOD:.2f} s, on a finite observation."
    )
