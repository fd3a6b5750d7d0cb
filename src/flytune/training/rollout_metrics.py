"""What every trainer writes down about the flights of an update."""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array

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
