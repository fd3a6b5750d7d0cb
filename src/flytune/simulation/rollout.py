"""The rollout on the device: many episodes, step by step, as one compiled loop.

Training, evaluation in flytune's own simulator and the benchmarks all step their episodes here; `host` has the other
loop, for simulators that JAX cannot look into and for trainers that want one step at a time.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from flytune.config.pytree import pytree
from flytune.physics import dynamics
from flytune.simulation import environment
from flytune.simulation.environment import Episode, Physics
from flytune.task.task import TaskFamily

Memory = Any  # a controller's pytree, the batch along the first axis


@pytree
class Draw:
    """The random numbers of one step of N episodes."""

    noise: Float[Array, "13 N"]  # standard normal, of the observation
    keys: Any = None  # [N] of the new episodes; None where none begins
    controller: Any = ()  # what the controller draws, for instance its exploration
    next_noise: Float[Array, "13 N"] | None = None  # of the observation after the step, before any new episode


class Step(NamedTuple):
    """The results of a rollout at every step, [T, ...]."""

    notes: Any  # what `decide` gave beside the action
    following: Any  # [T, N, 17] the observation after the step, where `Draw.next_noise` asks for it
    record: Any  # what `record` kept


def reset_all(family: TaskFamily, keys: Array) -> Episode:
    """New episodes for keys [N], the batch along the last axis."""
    return jax.vmap(partial(environment.reset, family), out_axes=-1)(keys)


def rollout(
    family: TaskFamily,
    decide: Callable[[Memory, Float[Array, "N 17"], Any, Episode], tuple[Memory, Float[Array, "N 4"], Any]],
    start: tuple[Episode, Memory],
    inputs: Any,
    *,
    ending: Callable[..., Any] = environment.restart,
    record: Callable[[Episode, Episode, environment.Outcome], Any],
    draw: Callable[[Any], Draw] = lambda given: given,
    fresh_memory: Memory = None,
    slack: Any = None,
    physics: Physics = dynamics.step,
    rematerialise: bool = False,
) -> tuple[tuple[Episode, Memory], Step]:
    """Episodes and memory after all steps, and the results of each step.

    The batch is the last axis of the episodes: arithmetic on one scalar per vehicle then runs along contiguous memory.

    Args:
        family: the task, or the family whose numbers each episode carries.
        decide: (memory, observation [N, 17], Draw.controller, episodes) -> (memory, action [N, 4], notes).
        start: N episodes and the controller's memory.
        inputs: scanned over time [T, ...]; each slice goes to `draw`.
        ending: what follows a step, `environment.restart` or `environment.hold`.
        record: (episode after, episode the step led to, outcome) -> what is kept; applied to one episode.
        draw: a slice of `inputs` -> the random numbers of a step.
        fresh_memory: the memory of new episodes, batched like the memory; None keeps the memory through an ending.
        slack: share of a bound by which a margin may be overdrawn before the episode ends; None for none.
        physics: the simulator's step.
        rematerialise: keep only the episodes between steps for a gradient, and compute each step again.
    """

    def look(episode: Episode, noise: Float[Array, "13"]) -> Float[Array, "17"]:
        return environment.observe(family.member(episode.numbers), episode, noise)

    def advance_one(episode: Episode, action: Float[Array, "4"], key: Any) -> Any:
        task = family.member(episode.numbers)
        moved, outcome = environment.step(task, episode, action, physics)
        if slack is not None:
            outcome = environment.with_slack(task, moved, outcome, slack)
        after, over = ending(family, episode, moved, outcome, key)
        return after, moved, over, record(after, moved, outcome)

    see = jax.vmap(look, in_axes=-1, out_axes=0)
    step = jax.vmap(advance_one, in_axes=(-1, -1, 0), out_axes=-1)
    if rematerialise:
        see, step = (jax.checkpoint(function, prevent_cse=False) for function in (see, step))

    def advance(carry: tuple[Episode, Memory], given: Any) -> Any:
        episodes, memory = carry
        now = draw(given)
        memory, action, notes = decide(memory, see(episodes, now.noise), now.controller, episodes)
        episodes, moved, over, recorded = step(episodes, action.T, now.keys)
        following = None if now.next_noise is None else see(moved, now.next_noise)
        if fresh_memory is not None:
            memory = jax.tree.map(partial(_where, over), fresh_memory, memory)
        return (episodes, memory), Step(notes, following, recorded)

    return jax.lax.scan(advance, start, inputs)


def _where(over: Array, new: Array, old: Array) -> Array:
    """The new value of the episodes that are over; the batch is the first axis."""
    return jnp.where(over.reshape(-1, *(1,) * (old.ndim - 1)), new, old)
