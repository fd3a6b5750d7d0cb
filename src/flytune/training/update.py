"""The parts of an update that trainers share: the optimiser step, the average of the weights, and the metrics."""

import ctypes
import dataclasses
import math
import os
import sys
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax.core import Tracer
from jaxtyping import Array, Float

from flytune.errors import Diverged
from flytune.simulation.environment import Episode, Outcome
from flytune.simulation.host import Transition
from flytune.task.observation import SIZE, input_scale
from flytune.task.task import Task
from flytune.task.termination import causes

T = TypeVar("T")

PARTS = 2  # of a batch, which two cores can compute at the same time
CORES = "FLYTUNE_CORES"  # in the environment: how many cores a training may use at most

# parameters of glibc's mallopt: the size from which a block is mapped by itself, the free memory that is given back,
# and the number of arenas; all but the first arena map blocks of 64 MB and more by themselves
MMAP_THRESHOLD, TRIM_THRESHOLD, ARENA_MAX = -3, -1, -8


def keep_freed_memory() -> None:
    """Let this process keep the memory that it frees, where the C library is glibc.

    An update allocates and frees tens of megabytes. Otherwise the operating system takes the memory back each time, and
    clears every page before it gives it out again: half of the time of an update.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None) if sys.platform == "linux" else None
    if mallopt is not None:
        mallopt(MMAP_THRESHOLD, 2**30)
        mallopt(TRIM_THRESHOLD, 2**31 - 1)
        mallopt(ARENA_MAX, 1)


def cores() -> int:
    """The number of processor cores that a training may use: those of this process, or fewer by `FLYTUNE_CORES`."""
    free = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    wanted = os.environ.get(CORES, "")
    return min(free, max(1, int(wanted))) if wanted.isdigit() else free


def in_threads(part: Callable[[int], T], number: int, tracer: Any) -> tuple[T, ...]:
    """`part` of 0, 1, ... of at most `PARTS` parts: at the same time where a training may use two cores.

    Args:
        part: of an index; it calls a program.
        number: of parts.
        tracer: an array of the caller, by which a trace is known; a thread of its own would not know of it.
    """
    if isinstance(tracer, Tracer):
        return tuple(map(part, range(number)))

    def finished(index: int) -> T:
        return jax.block_until_ready(part(index))

    return tuple((_threads().map if cores() > 1 else map)(finished, range(number)))


@lru_cache
def _threads() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(PARTS, "flytune-part")


class BusyCores:
    """How many threads work on one problem together, which pays only where both find a core of their own at once.

    Beside other load, two threads that wait for each other are slower than one. Then one works, and two try again
    after some updates.
    """

    FREE, PAUSE = 1.6, 15  # seconds of processor per second that show free cores; updates in one thread after fewer

    def __init__(self) -> None:
        self._pause = 0

    def run(self, work: Callable[[int], T]) -> T:
        """`work` of a number of threads, 1 or 2; its result does not depend on it."""
        if cores() == 1 or self._pause:
            self._pause = max(0, self._pause - 1)
            return work(1)
        wall, processor = time.perf_counter(), time.process_time()
        result = jax.block_until_ready(work(PARTS))
        if time.process_time() - processor < self.FREE * (time.perf_counter() - wall):
            self._pause = self.PAUSE
        return result


def network_scale(task: Task, factors: Sequence[float]) -> Float[Array, "inputs"]:
    """What each input of a network is multiplied with: one factor per block of the observation, 1 for all others."""
    return jnp.concatenate([input_scale(factors), jnp.ones(task.inputs - SIZE)])


def turned(task: Task, episodes: Episode, key: Array) -> Episode:
    """The episodes [..., N] before an update, in some of which the dials of the task are turned."""
    if not task.dial:
        return episodes
    keys = jax.random.split(key, episodes.steps.shape[-1])
    numbers = jax.vmap(task.turn, in_axes=(-1, 0), out_axes=-1)(episodes.numbers, keys)
    return dataclasses.replace(episodes, numbers=numbers)


def descend(optimiser: optax.GradientTransformation, gradient: T, memory: Any, parameters: T) -> tuple[T, Any]:
    """The parameters and the optimiser's memory after one step against the gradient."""
    # optax's type of parameters knows arrays and containers, not dataclasses that are pytrees
    change, memory = optimiser.update(gradient, memory, parameters)  # pyright: ignore[reportArgumentType]
    return optax.apply_updates(parameters, change), memory  # pyright: ignore[reportArgumentType, reportReturnType]


def averaged(ema: T, newest: T, ema_decay: float, updates: Array) -> T:
    """The moving average of weights: a plain mean over the first updates, then `ema_decay` of the old per update."""
    share = jnp.minimum(ema_decay, updates / (updates + 1.0))
    return jax.tree.map(lambda old, new: share * old + (1 - share) * new, ema, newest)


def rollout_metrics(
    task: Task, steps: Outcome | Transition, episode_reward: Any, episode_length: Any
) -> dict[str, Any]:
    """The rewards, terminations and lengths of a rollout; a mean over ended episodes is NaN where none ended.

    Args:
        task: what was flown.
        steps: the outcome of every step, [time, environment], in arrays of JAX or of NumPy.
        episode_reward: [time, environment], the sum of the rewards of each episode so far.
        episode_length: [time, environment], the number of steps of each episode so far.
    """
    return metrics_of(rollout_sums(task, steps, episode_reward, episode_length))


def rollout_sums(task: Task, steps: Outcome | Transition, episode_reward: Any, episode_length: Any) -> dict[str, Any]:
    """What `metrics_of` needs, as sums, so that those of the parts of a batch can be added; see `rollout_metrics`."""
    xp: Any = np if isinstance(steps.reward, np.ndarray) else jnp
    ended = steps.terminated | steps.truncated
    codes = xp.arange(len(causes(task.termination)))
    return {
        "steps": xp.asarray(float(ended.size)),
        "reward": xp.sum(steps.reward),
        "terms": {name: xp.sum(values) for name, values in steps.terms.items()},
        "terminations": xp.sum(steps.cause[..., None] == codes, axis=(0, 1)),
        "episodes": xp.sum(ended),
        "episode_reward": xp.sum(xp.where(ended, episode_reward, 0)),
        "episode_length": xp.sum(xp.where(ended, episode_length, 0)),
    }


def metrics_of(sums: dict[str, Any]) -> dict[str, Any]:
    """The metrics of a rollout, see `rollout_metrics`, from `rollout_sums`."""
    xp: Any = np if isinstance(sums["reward"], np.floating) else jnp
    number = sums["episodes"]

    def mean_at_end(total: Any) -> Any:
        return xp.where(number > 0, total / xp.maximum(number, 1), xp.nan)

    return {
        "reward": sums["reward"] / sums["steps"],
        "terms": {name: total / sums["steps"] for name, total in sums["terms"].items()},
        "terminations": sums["terminations"],
        "episodes": number,
        "episode_reward": mean_at_end(sums["episode_reward"]),
        "episode_length": mean_at_end(sums["episode_length"]),
    }


def metrics_row(task: Task, measured: dict[str, Any], update: int, steps: int, seconds: float) -> dict[str, Any]:
    """The row of metrics.jsonl of one update; a mean over episodes is None where no episode ended.

    Args:
        task: what is trained.
        measured: what the update measured, see `rollout_metrics`, and its losses.
        update: its number, 1 for the first.
        steps: environment steps of the training so far.
        seconds: of the training so far.

    Raises:
        Diverged: a number is not finite.
    """
    values = jax.tree.map(np.asarray, measured)

    def number(value: np.ndarray) -> float | None:
        return float(value) if np.isfinite(value) else None

    row: dict[str, Any] = {"update": update, "steps": steps, "seconds": round(seconds, 3)}
    row["episode_reward"] = number(values.pop("episode_reward"))
    row["reward"] = float(values.pop("reward"))
    row["terms"] = {name: float(value) for name, value in values.pop("terms").items()}
    row["terminations"] = dict(zip(causes(task.termination), map(int, values.pop("terminations")), strict=True))
    row["episodes"] = int(values.pop("episodes"))
    row["episode_length"] = number(values.pop("episode_length"))
    row |= {name: float(value) for name, value in sorted(values.items())}
    for name, value in row.items():
        if isinstance(value, float) and not math.isfinite(value):
            raise Diverged(
                f"training: {name} is {value} in update {update} ({steps} environment steps). "
                "A smaller learning_rate, or smaller weights in the reward, may help."
            )
    return row
