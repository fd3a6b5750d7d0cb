"""Episodes: reset, step and autoreset of one task, as pure functions for one vehicle; trainers apply `vmap`."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from flytune.config.pytree import pytree
from flytune.physics import dynamics
from flytune.physics.dynamics import State
from flytune.task.observation import observe
from flytune.task.reward import rewards
from flytune.task.situation import situation
from flytune.task.task import Task
from flytune.task.termination import SAFE, cause, margins


@pytree
class Episode:
    """Where an episode stands."""

    state: State
    last_action: Float[Array, "4"]  # the clipped action before; hover (0) after a reset
    steps: Int[Array, ""]  # control steps since the start
    reward: Float[Array, ""]  # sum since the start


@pytree
class Outcome:
    """What one step brought."""

    reward: Float[Array, ""]
    terms: dict[str, Float[Array, ""]]  # the reward of each term; they add up to `reward`
    margins: dict[str, Float[Array, ""]]  # of each termination condition
    cause: Int[Array, ""]  # why the episode failed, an index into `causes(task.termination)`, or SAFE
    terminated: Bool[Array, ""]  # failed; nothing comes after
    truncated: Bool[Array, ""]  # the horizon is reached; what would come after still counts


def reset(task: Task, key: jax.Array) -> Episode:
    """A new episode at a state drawn from the task's initial states."""
    return Episode(
        state=task.initial_state.draw(task.vehicle, key),
        last_action=jnp.zeros(4),
        steps=jnp.zeros((), jnp.int32),
        reward=jnp.zeros(()),
    )


def look(task: Task, episode: Episode, normal: Float[Array, "13"]) -> Float[Array, "17"]:
    """The noisy observation of an episode, for 13 standard normal numbers."""
    return observe(task.target, task.noise, episode.state, episode.last_action, normal)


def step(task: Task, episode: Episode, action: Float[Array, "4"]) -> tuple[Episode, Outcome]:
    """The episode one control period later, and what the step brought, judged on the true state it led to.

    The action is clipped to [-1, 1]; the clipped action is flown, penalised and later observed (paper R9).
    """
    action = jnp.clip(action, -1.0, 1.0)
    return judge(task, episode, dynamics.step(task.vehicle, episode.state, action), action)


def judge(task: Task, episode: Episode, state: State, action: Float[Array, "4"]) -> tuple[Episode, Outcome]:
    """The episode in the state that a clipped action led to, and what that is worth; whose physics did it is open."""
    here = situation(task.target, state, action - episode.last_action)
    terms = rewards(task.reward, here)
    left = margins(task.termination, here)
    why = cause(left)
    steps = episode.steps + 1
    terminated = why != SAFE
    outcome = Outcome(
        reward=sum(terms.values(), start=jnp.zeros(())),
        terms=terms,
        margins=left,
        cause=why,
        terminated=terminated,
        truncated=(steps >= task.horizon) & ~terminated,
    )
    return Episode(state=state, last_action=action, steps=steps, reward=episode.reward + outcome.reward), outcome


def autoreset(task: Task, episode: Episode, outcome: Outcome, key: jax.Array) -> Episode:
    """The episode itself, or a new one drawn with `key` where it has ended."""
    ended = outcome.terminated | outcome.truncated
    return jax.tree.map(lambda new, old: jnp.where(ended, new, old), reset(task, key), episode)
