"""The environment: episodes of a task as pure functions for one vehicle; a rollout applies `vmap` to them.

`reset` draws an episode. `observe` returns what a controller sees of it. `step` simulates one control period and
computes reward, margins and terminations of the new state. One of two endings follows: `restart` begins a new episode
where one is over, `hold` keeps a crashed vehicle where it is.
"""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from flytune.config.pytree import pytree
from flytune.physics import dynamics
from flytune.physics.dynamics import State
from flytune.physics.rotation import safe_norm
from flytune.physics.rotors import hover_action
from flytune.physics.vehicle import Vehicle
from flytune.simulation import CRASH_DISTANCE
from flytune.task import observation
from flytune.task.observation import RATE
from flytune.task.reward import rewards
from flytune.task.situation import position_error, situation
from flytune.task.task import Task, TaskFamily
from flytune.task.termination import SAFE, cause, margins

Physics = Callable[[Vehicle, State, Float[Array, "4"]], State]  # the state one control period later, in JAX


@pytree
class Episode:
    """The state of an episode."""

    state: State
    last_action: Float[Array, "4"]  # the clipped action before; after a reset the one that hovers
    steps: Int[Array, ""]  # control steps since the start; -1 in an episode that is held after a crash
    reward: Float[Array, ""]  # sum since the start
    numbers: Any = ()  # of the task's family, drawn for this episode


@pytree
class Outcome:
    """The result of one step."""

    reward: Float[Array, ""]
    terms: dict[str, Float[Array, ""]]  # the reward of each term; they add up to `reward`
    margins: dict[str, Float[Array, ""]]  # of each termination condition
    cause: Int[Array, ""]  # why the episode failed, an index into `causes(task.termination)`, or SAFE
    terminated: Bool[Array, ""]  # the episode failed; nothing comes after
    truncated: Bool[Array, ""]  # the horizon is reached; what would come after still counts


def begin(vehicle: Vehicle, state: State, numbers: Any = ()) -> Episode:
    """An episode that starts in a state, with the hover action as its last one."""
    return Episode(
        state=state,
        last_action=jnp.full(4, hover_action(vehicle), float),
        steps=jnp.zeros((), jnp.int32),
        reward=jnp.zeros(()),
        numbers=numbers,
    )


def reset(family: TaskFamily, key: jax.Array) -> Episode:
    """A new episode: the family draws its numbers, and the task its initial state."""
    numbers, key = family.draw(key)
    task = family.member(numbers)
    return begin(task.vehicle, task.initial_state.draw(task.vehicle, task.target, key), numbers)


def observe(task: Task, episode: Episode, normal: Float[Array, "13"]) -> Float[Array, "17"]:
    """The noisy observation of an episode, for 13 standard normal numbers."""
    noise = task.noise.at_rate(task.vehicle.control_rate)
    return observation.observe(task.reference(episode.steps), noise, episode.state, episode.last_action, normal)


def see(family: TaskFamily, episode: Episode, normal: Float[Array, "13"]) -> Float[Array, "_"]:
    """What a controller is given of an episode: the noisy observation, and the further inputs of the family."""
    return family.see(observe(family.member(episode.numbers), episode, normal), episode.numbers)


def step(
    task: Task, episode: Episode, action: Float[Array, "4"], physics: Physics = dynamics.step
) -> tuple[Episode, Outcome]:
    """The episode one control period later, and the result of the step, computed from the true state.

    The action is clipped to [-1, 1]; the clipped action is flown, penalised and later observed (paper R9).

    Args:
        task: the member of the family that the episode flies.
        episode: before the step.
        action: of each motor.
        physics: the simulator's step.
    """
    action = jnp.clip(action, -1.0, 1.0)
    return assess(task, episode, physics(task.vehicle, episode.state, action), action)


def assess(task: Task, episode: Episode, state: State, action: Float[Array, "4"]) -> tuple[Episode, Outcome]:
    """The episode in the state that a clipped action led to, and the result of the step, for any simulator.

    Args:
        task: the member of the family that the episode flies.
        episode: before the step.
        state: after it.
        action: that led there, clipped to [-1, 1].
    """
    steps = episode.steps + 1
    here = situation(task.reference(steps), state, per_unit_time(task.vehicle, action - episode.last_action))
    terms = rewards(task.reward, here)
    if task.vehicle.control_rate != RATE:  # so that the same flight earns the same in the same time
        terms = {name: term * (RATE / task.vehicle.control_rate) for name, term in terms.items()}
    left = margins(task.termination, here)
    why = cause(left)
    terminated = why != SAFE
    outcome = Outcome(
        reward=sum(terms.values(), start=jnp.zeros(())),
        terms=terms,
        margins=left,
        cause=why,
        terminated=terminated,
        truncated=(steps >= horizon(task)) & ~terminated,
    )
    reward = episode.reward + outcome.reward
    return dataclasses.replace(episode, state=state, last_action=action, steps=steps, reward=reward), outcome


def horizon(task: Task) -> Any:
    """The control steps after which a training episode is truncated."""
    return task.horizon if task.vehicle.control_rate == RATE else task.horizon * (task.vehicle.control_rate / RATE)


def per_unit_time(vehicle: Vehicle, change: Float[Array, "4"]) -> Float[Array, "4"]:
    """The change of an action in one control period, as a change in 0.01 s."""
    return change if vehicle.control_rate == RATE else change * (vehicle.control_rate / RATE)


def with_slack(task: Task, moved: Episode, outcome: Outcome, slack: Any) -> Outcome:
    """The outcome where an episode goes on until a margin is overdrawn by more than a share of its bound.

    The share is `slack` times the `slack` of the termination.

    Where an episode ends at the bound itself, a gradient never sees what lies beyond: a barrier is then weakest just
    where it is needed.

    Args:
        task: of the episode.
        moved: the episode after the step.
        outcome: of the step, with episodes that end at the bounds themselves.
        slack: share of a bound; 0 for none.
    """
    beyond = cause({name: margin + slack * task.termination[name].slack for name, margin in outcome.margins.items()})
    terminated = beyond != SAFE
    truncated = (moved.steps >= horizon(task)) & ~terminated
    return dataclasses.replace(outcome, cause=beyond, terminated=terminated, truncated=truncated)


def restart(
    family: TaskFamily, before: Episode, moved: Episode, outcome: Outcome, key: jax.Array
) -> tuple[Episode, Bool[Array, ""]]:
    """The episode itself, or a new one where it is over; and whether it is over.

    Args:
        family: that a new episode is drawn from.
        before: the episode before the step.
        moved: after it.
        outcome: of the step.
        key: that a new episode is drawn with.
    """
    over = outcome.terminated | outcome.truncated
    return jax.tree.map(lambda new, old: jnp.where(over, new, old), reset(family, key), moved), over


def hold(
    family: TaskFamily, before: Episode, moved: Episode, outcome: Outcome, key: None = None
) -> tuple[Episode, Bool[Array, ""]]:
    """The episode itself, or from a crash on the one before it; and whether the vehicle has crashed.

    Terminations end nothing here. The steps of a held episode are -1. The arguments are those of `restart`.
    """
    crashed = (before.steps < 0) | is_crashed(family.member(moved.numbers), moved.state, moved.steps)
    held = dataclasses.replace(before, steps=jnp.full_like(before.steps, -1))
    return jax.tree.map(lambda new, old: jnp.where(crashed, old, new), moved, held), crashed


def is_crashed(task: Task, state: State, steps: Any) -> Bool[Array, ""]:
    """Whether a vehicle has crashed after some steps: it left the ball around its target, or is not finite.

    The ball has a radius of 10 m, and of twice the farthest start where that is more.
    """
    distance = safe_norm(position_error(task.reference(steps), state.position))
    radius = jnp.maximum(CRASH_DISTANCE, 2 * task.initial_state.farthest())
    body = jnp.stack([*state.position, *state.attitude, *state.velocity, *state.body_rate])
    return ~((distance <= radius) & jnp.all(jnp.isfinite(body)))


def margins_along(
    task: Task, settings: Any, states: State, changes: Float[Array, "T 4"], steps: Int[Array, "T"]
) -> dict[str, Float[Array, "T"]]:
    """The margins of each termination along one trial, first axis time.

    Args:
        task: the task, or where its dials are turned in flight the family.
        settings: of the dials, each [T]; empty for a task without dials.
        states: the states [T, ...].
        changes: of the action before each state.
        steps: the control steps from the start to each state.
    """

    def one(numbers: Any, state: State, change: Array, steps: Array) -> dict[str, Array]:
        here = task.member(numbers)
        return margins(here.termination, situation(here.reference(steps), state, per_unit_time(here.vehicle, change)))

    return jax.vmap(one)(settings, states, changes, steps)
