"""The metrics of an update: what its rollout measured, and the row of metrics.jsonl."""

import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from flytune.errors import Diverged
from flytune.simulation.environment import Episode, Outcome
from flytune.task.task import Task
from flytune.task.termination import causes


def account(task: Task, outcome: Outcome, moved: Episode) -> dict[str, Any]:
    """The rewards, ends and lengths of a batch of steps; means over finished episodes are NaN where none finished.

    Args:
        task: what was flown.
        outcome: of every step, [time, environment].
        moved: the episodes each step led to, before any reset.
    """
    ended = outcome.terminated | outcome.truncated
    number = jnp.sum(ended)

    def mean_at_end(values: Array) -> Array:
        return jnp.where(number > 0, jnp.sum(jnp.where(ended, values, 0)) / jnp.maximum(number, 1), jnp.nan)

    codes = jnp.arange(len(causes(task.termination)))
    return {
        "reward": jnp.mean(outcome.reward),
        "terms": jax.tree.map(jnp.mean, outcome.terms),
        "terminations": jnp.sum(outcome.cause[..., None] == codes, axis=(0, 1)),
        "episodes": number,
        "episode_reward": mean_at_end(moved.reward),
        "episode_length": mean_at_end(moved.steps),
    }


def metrics_row(task: Task, measured: dict[str, Any], update: int, steps: int, seconds: float) -> dict[str, Any]:
    """The row of metrics.jsonl of one update; a mean over episodes is None where no episode ended.

    Args:
        task: what is trained.
        measured: what the update measured, see `account`, and its losses.
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
