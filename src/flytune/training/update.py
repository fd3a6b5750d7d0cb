"""The parts of an update that trainers share: the optimiser step, the average of the weights, and the metrics."""

import dataclasses
import math
from collections.abc import Sequence
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float

from flytune.errors import Diverged
from flytune.simulation.environment import Episode, Outcome
from flytune.simulation.host import Transition
from flytune.task.observation import SIZE, input_scale
from flytune.task.task import Task
from flytune.task.termination import causes

T = TypeVar("T")
SMALLER_STEPS = (
    "A smaller learning rate (--set apg.learning_rate=VALUE or ppo.learning_rate=VALUE) helps; that of the presets is "
    "a start."
)
LARGE = 1e4  # per step; rewards and costs of the presets are near 1


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
                f"training: {name} is {value} in update {update} ({steps} environment steps). {_remedy(row)}"
            )
    return row


def _remedy(row: dict[str, Any]) -> str:
    """What helps where numbers stopped being finite: the cause, as far as the metrics of the update show it."""
    rewards = row["terms"] | {"": row["reward"]}
    if not all(math.isfinite(each) for each in rewards.values()):
        flight = (
            "Tighter bounds in [termination], which end an episode before that, help; or a vehicle that turns less "
            "within a control step of 0.01 s."
        )
        if row["update"] == 1:
            return f"The flight of a vehicle is no longer finite. {flight}"
        return f"The weights of the policy or the flight of a vehicle are no longer finite. {SMALLER_STEPS} {flight}"
    largest = max(row["terms"], key=lambda name: abs(row["terms"][name]))
    if abs(row["terms"][largest]) > LARGE:
        return (
            f"The term reward.{largest} is {row['terms'][largest]:.3g} per step, which is too much for single "
            f"precision. Give it a smaller weight; the terms of the presets are below 1."
        )
    if abs(row.get("objective", 0.0) - row["reward"]) > LARGE:
        return (
            f"The barriers cost {row['reward'] - row['objective']:.3g} per step, which is too much for single "
            "precision. Give a smaller apg.barrier_weight, or smaller values of termination.NAME.barrier."
        )
    if row["update"] == 1 and "objective" in row:  # of the analytic policy gradient, taken before the first step
        return (
            "Nothing has been learned yet, so that it comes from the task. A smaller apg.window helps, since gradients "
            "grow with the number of steps; or smaller values of sharpness, wide and narrow in the reward."
        )
    return SMALLER_STEPS
