"""The rollout on the device: many episodes, step by step, as one compiled loop.

Training, evaluation in flytune's own simulator and the benchmarks all step their episodes here; `host` has the other
loop, for simulators that JAX cannot look into and for trainers that want one step at a time.
"""

import contextlib
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from flytune.config.pytree import pytree
from flytune.kernels.batched import available, batched
from flytune.kernels.dense import Actor
from flytune.kernels.emit import Unsupported
from flytune.kernels.window import window
from flytune.physics import dynamics
from flytune.simulation import environment
from flytune.simulation.environment import Episode, Physics
from flytune.task.observation import draw_noise
from flytune.task.task import Task, TaskFamily

Memory = Any  # a controller's pytree, the batch along the first axis


@pytree
class Draw:
    """The random numbers of one step of N episodes."""

    noise: Any  # of the observation: standard normal numbers [13, N], or keys [N] that they are drawn with
    keys: Any = None  # [N] of the new episodes; None where none begins
    controller: Any = ()  # what the controller draws, for instance its exploration
    next_noise: Any = None  # likewise, of the observation after the step, before any new episode


class Step(NamedTuple):
    """The results of a rollout at every step, [T, ...]."""

    notes: Any  # what `decide` gave beside the action
    following: Any  # [T, N, ...] the observation after the step, where `Draw.next_noise` asks for it
    record: Any  # what `record` kept


def reset_all(family: TaskFamily, keys: Array) -> Episode:
    """New episodes for keys [N], the batch along the last axis."""
    return jax.vmap(partial(environment.reset, family), out_axes=-1)(keys)


def split_keys(key: Array, steps: int, number: int) -> Array:
    """Keys [steps, number] from a key; many times faster on a CPU than `jax.random.split`, which gives others."""

    def one(key: Array, index: Array) -> Array:
        return jax.random.key_data(jax.random.fold_in(jax.random.wrap_key_data(key), index))

    words = batched(one, jax.random.key_data(key))(jnp.arange(steps * number, dtype=jnp.uint32))
    return jax.random.wrap_key_data(words.T).reshape(steps, number)


def rollout(
    family: TaskFamily,
    decide: Callable[[Memory, Float[Array, "N _"], Any, Episode], tuple[Memory, Float[Array, "N 4"], Any]],
    start: tuple[Episode, Memory],
    inputs: Any,
    *,
    ending: Callable[..., Any] = environment.restart,
    record: Callable[[Task, Episode, Episode, environment.Outcome], Any],
    draw: Callable[[Any], Draw] = lambda given: given,
    fresh_memory: Memory = None,
    slack: Any = None,
    physics: Physics = dynamics.step,
) -> tuple[tuple[Episode, Memory], Step]:
    """Episodes and memory after all steps, and the results of each step.

    The batch is the last axis of the episodes: arithmetic on one scalar per vehicle then runs along contiguous memory.

    Args:
        family: the task, or the family whose numbers each episode carries.
        decide: (memory, observation [N, 17 and further inputs], Draw.controller, episodes) -> (memory, action [N, 4],
            notes). With an `Actor` all steps are one kernel where `inputs` are the keys of all steps.
        start: N episodes and the controller's memory.
        inputs: scanned over time [T, ...]; each slice goes to `draw`.
        ending: what follows a step, `environment.restart` or `environment.hold`.
        record: (task, episode after, episode the step led to, outcome) -> what is kept; applied to one episode.
        draw: a slice of `inputs` -> the random numbers of a step.
        fresh_memory: the memory of new episodes, batched like the memory; None keeps the memory through an ending.
        slack: share of a bound by which a margin may be overdrawn before the episode ends; None for none.
        physics: the simulator's step.
    """

    episodes, memory = start
    restore = ravel_pytree(jax.tree.map(lambda leaf: leaf[..., 0], episodes))[1]

    def look(family: TaskFamily, numbers: Float[Array, "K"], noise: Any) -> Float[Array, "_"]:
        episode = restore(numbers)
        return environment.see(family, episode, _normal(noise))

    def move(family: TaskFamily, numbers: Float[Array, "K"], action: Float[Array, "4"], key: Any, noise: Any) -> Any:
        episode = restore(numbers)
        task = family.member(episode.numbers)
        moved, outcome = environment.step(task, episode, action, physics)
        if slack is not None:
            outcome = environment.with_slack(task, moved, outcome, slack)
        after, over = ending(family, episode, moved, outcome, key)
        following = None if noise is None else environment.see(family, moved, _normal(noise))
        return ravel_pytree(after)[0], over, following, record(task, after, moved, outcome)

    def move_packed(*given: Any) -> Any:
        numbers, over, following, kept = move(*given)
        return numbers, over, following, ravel_pytree(kept)[0]

    see, step = batched(look, family), batched(move_packed, family)

    def advance(carry: tuple[Array, Memory], given: Any) -> Any:
        numbers, memory = carry
        now = draw(given)
        seen = see(numbers, now.noise).T
        memory, action, notes = decide(memory, seen, now.controller, unpack(numbers))
        numbers, over, following, kept = step(numbers, action.T, now.keys, now.next_noise)
        following = None if following is None else following.T
        if fresh_memory is not None:
            memory = jax.tree.map(partial(_where, over), fresh_memory, memory)
        return (numbers, memory), Step(notes, following, kept)

    pack = jax.vmap(lambda episode: ravel_pytree(episode)[0], in_axes=-1, out_axes=-1)
    unpack = jax.vmap(restore, in_axes=-1, out_axes=-1)
    kept = jax.eval_shape(lambda: _kept_of_one(move, family, episodes, inputs, draw))
    restore_kept = ravel_pytree(jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), kept))[1]

    def fly() -> tuple[tuple[Array, Memory], Step]:
        if isinstance(decide, Actor) and available() and isinstance(inputs, Draw) and inputs.next_noise is None:
            with contextlib.suppress(Unsupported):  # what has no form as a kernel says so below
                numbers, packed = window(look, move_packed, family, decide, pack(episodes), inputs.noise, inputs.keys)
                return (numbers, memory), Step((), None, packed)
        return jax.lax.scan(advance, (pack(episodes), memory), inputs)

    (numbers, memory_after), steps = fly()
    record_of_all = jax.vmap(jax.vmap(restore_kept, in_axes=-1, out_axes=-1))(steps.record)
    return (unpack(numbers), memory_after), steps._replace(record=record_of_all)


def _kept_of_one(move: Callable[..., Any], family: TaskFamily, episodes: Episode, inputs: Any, draw: Any) -> Any:
    """What is recorded of the first episode at the first step."""
    first = draw(jax.tree.map(lambda leaf: leaf[0], inputs))
    numbers = ravel_pytree(jax.tree.map(lambda leaf: leaf[..., 0], episodes))[0]
    key, noise = jax.tree.map(lambda leaf: leaf[..., 0], (first.keys, first.next_noise))
    return move(family, numbers, jnp.zeros(4), key, noise)[3]


def _normal(noise: Any) -> Float[Array, "13"]:
    """The normal numbers of an observation, drawn where a key is given."""
    return draw_noise(noise) if jnp.issubdtype(noise.dtype, jax.dtypes.prng_key) else noise


def _where(over: Array, new: Array, old: Array) -> Array:
    """The new value of the episodes that are over; the batch is the first axis."""
    return jnp.where(over.reshape(-1, *(1,) * (old.ndim - 1)), new, old)
