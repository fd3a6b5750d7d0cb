"""Learning curves of a study: when a training survives, and when it stops rising."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from flytune.task.task import Task

Rows = Sequence[Mapping[str, Any]]
SMOOTH = 0.1  # of a training: the share of its updates a smoothed reward is the mean of
SURVIVES = 0.9  # of the horizon


def column(rows: Rows, name: str) -> np.ndarray:
    """One number per update, NaN where a row has none."""
    return np.array([np.nan if row.get(name) is None else float(row[name]) for row in rows])


def smoothed_reward(rows: Rows) -> np.ndarray:
    """Mean episode reward over the tenth of the training that ends with each update; over fewer at the beginning."""
    rewards = column(rows, "episode_reward")
    width = max(round(SMOOTH * len(rewards)), 1)
    known = np.isfinite(rewards)
    total, count = (np.concatenate([[0.0], np.cumsum(part)]) for part in (np.where(known, rewards, 0.0), known))
    end = np.arange(1, len(rewards) + 1)
    begin = np.maximum(end - width, 0)
    number = count[end] - count[begin]
    return np.where(number > 0, (total[end] - total[begin]) / np.maximum(number, 1), np.nan)


def reward_at(rows: Rows, share: float) -> float:
    """The smoothed episode reward at a share of the training, 0 to 1."""
    return float(smoothed_reward(rows)[max(round(share * len(rows)), 1) - 1])


def steps_to_survive(rows: Rows, task: Task) -> float | None:
    """Environment steps until episodes first last nine tenths of the horizon on average; None if they never do."""
    long_enough = np.flatnonzero(column(rows, "episode_length") >= SURVIVES * task.horizon)
    return float(rows[long_enough[0]]["steps"]) if long_enough.size else None


def steps_to_share(rows: Rows, share: float) -> float:
    """Environment steps until the smoothed episode reward first reaches a share of its final value."""
    course = smoothed_reward(rows)
    return float(rows[int(np.argmax(course >= share * course[-1]))]["steps"])
