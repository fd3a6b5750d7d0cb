"""Quantiles and intervals that keep the trials that failed. NumPy only.

Conventions for per-trial values: +inf is a trial that failed (did not settle, or crashed) and stays in as the worst;
NaN is a trial to which the metric does not apply (the overshoot of a small step) and is left out.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from flytune.errors import BadInput

LEVELS = {"median": 0.5, "p25": 0.25, "p75": 0.75, "p95": 0.95, "max": 1.0}


def ranked(values: Float[np.ndarray, "N *rest"], q: float) -> Any:
    """Smallest values [*rest], along the first axis, that at least the share q of the N does not exceed.

        quantile = sorted(values)[ceil(q N) - 1], and the smallest value for q = 0

    The inverted CDF is always a value that was measured. Interpolating would mix a measured value with infinity.

    Source: Hyndman and Fan, Sample quantiles in statistical packages (1996), definition 1.
    """
    rank = math.ceil(q * len(values) - 1e-9)  # q N is rounded: 0.07 * 100 is a little above 7
    return np.sort(values, axis=0)[max(rank, 1) - 1]


def quantile(values: Float[np.ndarray, "N"], q: float) -> float | None:
    """The quantile of the trials to which the metric applies, see `ranked`; None if infinite, or without any trial."""
    counted = values[~np.isnan(values)]
    return finite(ranked(counted, q)) if counted.size else None


def summary(values: Float[np.ndarray, "N"], names: Sequence[str]) -> dict[str, float | None]:
    """The quantiles of these names (keys of LEVELS); None where infinite."""
    return {name: quantile(values, LEVELS[name]) for name in names}


def median(values: Float[np.ndarray, "N"]) -> float | None:
    """The median as `quantile` defines it; None if infinite."""
    return quantile(values, 0.5)


def finite(value: float | np.floating) -> float | None:
    """The value as a plain float; None where it is infinite or NaN, which JSON does not have."""
    return float(value) if np.isfinite(value) else None


def bootstrap_interval(
    values: Sequence[Sequence[float] | np.ndarray] | np.ndarray,
    statistic: Callable[[np.ndarray], float | None] = median,
    *,
    number: int = 2000,
    seed: int = 0,
) -> tuple[float | None, float | None]:
    """The 95 % interval (low, high) of a statistic over training seeds and the trials of each; None where infinite.

    Draws seeds with replacement, then as many trials of each drawn seed with replacement, and takes the statistic of
    all drawn trials together; the interval holds the middle 95 % of `number` such draws. Seeds come first because
    the trials of one seed share its policy: pooling them would pretend to more independent data than there is. With
    few seeds (five in the paper) the interval is known to be somewhat too narrow.

    Args:
        values: [seeds][trials], per-trial values of one metric; the numbers of trials may differ.
        statistic: from the drawn trials [M] to a number; None counts as +inf.
        number: number of draws.
        seed: of the random draws; the same seed gives the same interval.

    Raises:
        BadInput: without a seed, or with a seed that has no trial.

    Source: Saravanan, Berman and Sober, Application of the hierarchical bootstrap to multi-level data in neuroscience
    (2020).
    """
    groups = [np.asarray(trials, dtype=np.float64) for trials in values]
    sizes = [trials.size for trials in groups]
    if not groups or 0 in sizes:
        raise BadInput(
            "values: every seed needs at least one trial, and there must be a seed; leave out what was not flown"
        )
    generator = np.random.default_rng(seed)
    at_once = len(set(sizes)) == 1 and number * sum(sizes) <= 20_000_000  # few enough numbers to hold
    drawn = _draw_at_once(np.stack(groups), number, generator) if at_once else _draw(groups, number, generator)
    estimates = (statistic(trials) for trials in drawn)
    draws = np.array([np.inf if estimate is None else estimate for estimate in estimates])
    return quantile(draws, (1 - 0.95) / 2), quantile(draws, (1 + 0.95) / 2)


def _draw_at_once(table: np.ndarray, number: int, generator: np.random.Generator) -> np.ndarray:
    """All draws [number, seeds * trials] from a table [seeds, trials]."""
    seeds, trials = table.shape
    chosen = generator.integers(seeds, size=(number, seeds, 1))
    return table[chosen, generator.integers(trials, size=(number, seeds, trials))].reshape(number, -1)


def _draw(groups: Sequence[np.ndarray], number: int, generator: np.random.Generator) -> Iterator[np.ndarray]:
    """One draw after the other."""
    for _ in range(number):
        drawn = [groups[group] for group in generator.integers(len(groups), size=len(groups))]
        yield np.concatenate([generator.choice(trials, size=trials.size) for trials in drawn])
