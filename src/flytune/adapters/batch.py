"""A batch of episodes behind a NumPy interface, for the vector environments of other people's trainers."""

import dataclasses
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from flytune.adapters.single import PARTS
from flytune.simulation import environment
from flytune.simulation.environment import Episode
from flytune.task.observation import NOISY
from flytune.task.task import Task

Begun = tuple[Episode, jax.Array, jax.Array]  # episodes, key, what is seen of them


@dataclasses.dataclass(frozen=True, kw_only=True)
class Transition:
    """What one step of N environments brought; an environment that ended has already begun its next episode."""

    observation: np.ndarray  # [N, 17] what to act on next: of the new episode where the old one ended
    final_observation: np.ndarray  # [N, 17] of the state the action led to, before any new episode
    reward: np.ndarray  # [N]
    terms: dict[str, np.ndarray]  # [N] each: the reward of each term; they add up to `reward`
    terminated: np.ndarray  # [N] bool; failed, nothing comes after
    truncated: np.ndarray  # [N] bool; the horizon is reached, what would come after still counts
    cause: np.ndarray  # [N] int; why it failed, an index into `causes(task.termination)`, or SAFE
    episode_return: np.ndarray  # [N] sum of rewards since the episode's start, this step included
    episode_length: np.ndarray  # [N] int; steps since the episode's start, this one included

    @property
    def ended(self) -> np.ndarray:
        """Which environments began a new episode, [N] bool."""
        return self.terminated | self.truncated


class Batch:
    """N episodes of one task that step together and start anew where they end: one compiled call per step.

    `episodes`, `key` and `observation` are all that changes: kept and put back, they let it go on exactly as before
    (which is why their buffers are not donated to the compiled step).

    Args:
        task: what is flown.
        number: how many environments.
        seed: of starts and noise, 0 to 2^32 - 1.
    """

    episodes: Episode  # the batch lies along the last axis
    key: jax.Array
    observation: np.ndarray  # [N, 17] what was last seen

    def __init__(self, task: Task, number: int, seed: int = 0) -> None:
        self.task, self.number = task, number
        self._numbers = jax.tree.map(jnp.asarray, task)  # on the device once, not at every call
        self.reset(seed)

    def reset(self, seed: int | None = None, which: np.ndarray | None = None) -> np.ndarray:
        """The observation [N, 17] after a new start of the environments in the mask `which` [N], all where None.

        A seed makes everything that follows reproducible; without one the random numbers go on.
        """
        if seed is not None:
            self.key = jax.random.key(seed)
        if which is None:
            self.episodes, self.key, seen = _start(self._numbers, self.key, self.number)
            self.observation = np.array(seen)
        else:
            self.episodes, self.key, seen = _restart(self._numbers, self.episodes, self.key, which)
            self.observation = np.where(which[:, None], seen, self.observation)
        return self.observation

    def step(self, action: np.ndarray) -> Transition:
        """What actions [N, 4] brought; they are clipped to [-1, 1]."""
        self.episodes, self.key, *report = _step(self._numbers, self.episodes, self.key, action)
        # copies, because what JAX gives is read-only and may be memory it uses again
        self.observation, final_observation = np.array(report[0]), np.array(report[1])
        reward, cause, truncated, episode_return, episode_length, *terms = np.array(report[2], float)
        return Transition(
            observation=self.observation,
            final_observation=final_observation,
            reward=reward,
            terms=dict(zip(sorted(self.task.reward), terms, strict=True)),
            terminated=cause >= 0,
            truncated=truncated > 0,
            cause=cause.astype(np.int64),
            episode_return=episode_return,
            episode_length=episode_length.astype(np.int64),
        )

    def bodies(self) -> np.ndarray:
        """Where the vehicles are and how they move, [N, 17] as in `single.PARTS`."""
        state = self.episodes.state
        return np.stack([np.asarray(number) for name in PARTS for number in getattr(state, name)], axis=-1)


@partial(jax.jit, static_argnames="number")
def _start(task: Task, key: jax.Array, number: int) -> Begun:
    key, start_key, noise_key = jax.random.split(key, 3)
    episodes = jax.vmap(partial(environment.reset, task), out_axes=-1)(jax.random.split(start_key, number))
    return episodes, key, _look(task, episodes, noise_key)


@jax.jit
def _restart(task: Task, episodes: Episode, key: jax.Array, which: jax.Array) -> Begun:
    fresh, key, seen = _start(task, key, which.shape[0])
    return jax.tree.map(lambda new, old: jnp.where(which, new, old), fresh, episodes), key, seen


@jax.jit
def _step(task: Task, episodes: Episode, key: jax.Array, action: jax.Array) -> Any:
    key, noise_key, start_key = jax.random.split(key, 3)
    moved, outcome = jax.vmap(partial(environment.step, task), in_axes=(-1, 0), out_axes=-1)(episodes, action)
    start_keys = jax.random.split(start_key, action.shape[0])
    after = jax.vmap(partial(environment.autoreset, task), in_axes=(-1, -1, 0), out_axes=-1)(moved, outcome, start_keys)
    # one matrix, so that few arrays cross to the host; float32 holds these whole numbers exactly
    numbers = [outcome.reward, outcome.cause, outcome.truncated, moved.reward, moved.steps]
    numbers += [outcome.terms[name] for name in sorted(outcome.terms)]
    report = jnp.stack([number.astype(jnp.float32) for number in numbers])
    return after, key, _look(task, after, noise_key), _look(task, moved, noise_key), report


def _look(task: Task, episodes: Episode, key: jax.Array) -> jax.Array:
    noise = jax.random.normal(key, (NOISY, episodes.steps.shape[-1]))
    return jax.vmap(partial(environment.look, task), in_axes=-1, out_axes=0)(episodes, noise)
