"""Tracking: how far a vehicle is from a target that moves, along and across its path, and how late. NumPy only.

Source: docs, definitions.
"""

import dataclasses
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from flytune.evaluation.flights import Flights
from flytune.evaluation.statistics import summary

LARGEST_LAG = 1.0  # s; a vehicle farther behind or ahead does not follow
STILL = 1e-3  # m/s; a slower target has no direction, and shows no lag
ERRORS = ("median", "p75", "p95", "max")
LAGS = ("median", "p25", "p75", "p95")

PerTrial = Float[np.ndarray, "N"]


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Tracking:
    """The distance from a moving target of N trials, over the second half of each; +inf where the trial crashed."""

    begin: float  # s, from which on samples count
    mean_error: PerTrial  # m, over time
    p95_error: PerTrial  # m
    maximum_error: PerTrial  # m
    along_error: PerTrial  # m, mean of the size along the direction of the target's motion
    across_error: PerTrial  # m, mean distance from the line through the target in this direction
    lag: PerTrial  # s, positive behind; +inf where it is beyond LARGEST_LAG; NaN where the target does not move

    def to_dict(self) -> dict[str, Any]:
        """Plain Python values; quantiles over the trials, None where infinite."""
        errors = [field.name for field in dataclasses.fields(self) if field.name.endswith("_error")]
        return {
            "begin": self.begin,
            **{name: summary(getattr(self, name), ERRORS) for name in errors},
            "lag": summary(self.lag, LAGS),
        }


def track(flights: Flights, crashed: Bool[np.ndarray, "N"]) -> Tracking:
    """The tracking of flights to a target that moves without steps.

    The first half of a trial is its approach from a start at rest, and does not count. So every controller is judged
    over the same samples, whether or not it ever came near.

    Args:
        flights: with a `target_position` of each sample.
        crashed: which trials count as infinitely far.
    """
    time = np.asarray(flights.time, np.float64)
    counted = time >= time[-1] / 2 - 1e-9
    position = np.where(crashed[:, None, None], 0.0, np.asarray(flights.position, np.float64))
    error = (position - flights.target_position)[:, counted]
    velocity = np.gradient(flights.target_position, time, axis=0)
    speed = np.linalg.norm(velocity, axis=-1, keepdims=True)
    direction = np.divide(velocity, speed, out=np.zeros_like(velocity), where=speed > STILL)[counted]
    along = np.einsum("nki,ki->nk", error, direction)
    across = np.linalg.norm(error - along[..., None] * direction, axis=-1)
    distance = np.linalg.norm(error, axis=-1)
    per_trial = {
        "mean_error": distance.mean(axis=1),
        "p95_error": np.quantile(distance, 0.95, axis=1, method="inverted_cdf"),
        "maximum_error": distance.max(axis=1),
        "along_error": np.abs(along).mean(axis=1),
        "across_error": across.mean(axis=1),
    }
    lag = _lag(position, flights.target_position, time, counted)
    return Tracking(
        begin=float(time[counted][0]),
        **{name: np.where(crashed, np.inf, values) for name, values in per_trial.items()},
        lag=np.where(crashed & ~np.isnan(lag), np.inf, lag),
    )


def _lag(
    position: Float[np.ndarray, "N K 3"],
    target: Float[np.ndarray, "K 3"],
    time: Float[np.ndarray, "K"],
    counted: Bool[np.ndarray, "K"],
) -> PerTrial:
    """The shift of the target in time, in s, that leaves the smallest mean square distance; positive behind.

        lag = argmin over s of mean |p(t) - p*(t - s)|^2,    |s| <= LARGEST_LAG

    Found on samples, then by the parabola through the smallest value and its neighbours.
    """
    period = time[-1] / (time.size - 1)
    samples = np.flatnonzero(counted)
    most = min(round(LARGEST_LAG / period), samples.size // 4)
    samples = samples[: samples.size - most]  # behind which the target is known for every shift
    moves = np.linalg.norm(np.diff(target[samples[0] : samples[-1] + 1], axis=0), axis=-1)
    if moves.mean() < STILL * period or most < 1:
        return np.full(len(position), np.nan)
    shifts = np.arange(-most, most + 1)
    seen = position[:, samples]
    left = np.stack([np.square(seen - target[samples - shift]).sum(axis=-1).mean(axis=1) for shift in shifts], axis=1)
    best = left.argmin(axis=1)
    inside = (best > 0) & (best < shifts.size - 1)
    best = np.clip(best, 1, shifts.size - 2)
    rows = np.arange(len(left))
    before, here, after = (left[rows, best + step] for step in (-1, 0, 1))
    bend = before - 2 * here + after
    part = np.divide(before - after, 2 * bend, out=np.zeros_like(bend), where=bend > 0)
    return np.where(inside, (shifts[best] + part) * period, np.inf)
