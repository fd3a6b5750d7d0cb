"""Quantiles and intervals that keep the trials that failed. NumPy only.

Conventions for per-trial values: +inf is a trial that failed (did not settle, or crashed) and stays in as the worst;
NaN is a trial to which the metric does not apply (the overshoot of a small step) and is left out.
"""

from collections.abc import Callable, Iterator, Sequence

import numpy as np
from jaxtyping import Float

from flytune.errors import BadInput

LEVELS = {"median": 0.5, "p25": 0.25, "p75": 0.75, "p95": 0.95, "max": 1.0}


def quantile(values: Float[np.ndarray, "N"], q: float) -> float | None:
    """Smallest value that at least the share q of the trials does not exceed; None if infinite, or without any trial.

        quantile = sorted(values)[ceil(q N) - 1], and the smallest value for q = 0

    The inverted CDF is always a value that was measured. Interpolating would mix a measured value with infinity.

    Source: Hyndman and Fan, Sample quantiles in statistical packages (1996), definition 1.
    """
    counted = np.sort(values[~np.isnan(values)])
    if counted.size == 0:
        return None
    rank = int(np.ceil(q * counted.size - 1e-9))  # q N is rounded: 0.07 * 100 is a little above 7
    return finite(counted[max(rank, 1) - 1])


def summary(values: Float[np.ndarray, "N"], names: Sequence[str]) -> dict[str, float | None]:
    """The quantiles named (keys of LEVELS), in that order; None where infinite."""
    return {name: quantile(values, LEVELS[name]) for name in names}


def median(values: Float[np.ndarray, "N"]) -> float | None:
    """The median as `quantile` defines it; None if infinite."""
    return quantile(values, 0.5)


def finite(value: float | np.floating) -> float | None:
    """The value as a plain float, None where it is infinite or NaN (JSON knows neither)."""
    return float(value) if np.isfinite(value) else None


def bootstrap_interval(
    values: Sequence[Sequence[float] | np.ndarray] | np.ndarray,
    statistic: Callable[[np.ndarray], float | None] = median,
    *,
    level: float = 0.95,
    number: int = 2000,
    seed: int = 0,
) -> tuple[float | None, float | None]:
    """Confidence interval (low, high) of a statistic over training seeds and the trials of each; None where infinite.

    Draws seeds with replacement, then as many trials of each drawn seed with replacement, and takes the statistic of
    all drawn trials together; the interval holds the middle `level` of `number` such draws. Seeds come first because
    the trials of one seed share its policy: pooling them would pretend to more independent data than there is. With
    few seeds (five in the paper) the interval is known to be somewhat too narrow.

    Args:
        values: [seeds][trials], per-trial values of one metric; the numbers of trials may differ.
        statistic: from the drawn trials [M] to a number; None counts as +inf.
        level: share of the draws inside the interval, in (0, 1).
        number: number of draws.
        seed: of the random draws; the same seed gives the same interval.

    Raises:
        BadInput: without a seed, with a seed that has no trial, or with a level outside (0, 1).

    Source: Saravanan, Berman and Sober, Application of the hierarchical bootstrap to multi-level data in neuroscience
    (2020).
    """
    groups = [np.asarray(trials, dtype=np.float64) for trials in values]
    if not groups or any(trials.size == 0 for trials in groups):
        raise BadInput(
            "values: every seed needs at least one trial, and there must be a seed; leave out what was not flown"
        )
    if not 0 < level < 1:
        raise BadInput(f"level: {level} is not in (0, 1); use 0.95 for a 95 % interval")
    generator = np.random.default_rng(seed)
    drawn = _draw_alike(groups, number, generator) if _alike(groups, number) else _draw(groups, number, generator)
    estimates = (statistic(trials) for trials in drawn)
    draws = np.array([np.inf if estimate is None else estimate for estimate in estimates])
    return quantile(draws, (1 - level) / 2), quantile(draws, (1 + level) / 2)


def _alike(groups: Sequence[np.ndarray], number: int) -> bool:
    """Whether all draws can be made at once: seeds of as many trials, and few enough numbers to hold."""
    sizes = {trials.size for trials in groups}
    return len(sizes) == 1 and number * sum(trials.size for trials in groups) <= 20_000_000


def _draw_alike(groups: Sequence[np.ndarray], number: int, generator: np.random.Generator) -> np.ndarray:
    """All draws [number, seeds * trials] at once."""
    table = np.stack(groups)
    seeds, trials = table.shape
    chosen = generator.integers(seeds, size=(number, seeds, 1))
    return table[chosen, generator.integers(trials, size=(number, seeds, trials))].reshape(number, -1)


def _draw(groups: Sequence[np.ndarray], number: int, generator: np.random.Generator) -> Iterator[np.ndarray]:
    """One draw after the other."""
    for _ in range(number):
        drawn = [groups[group] for group in generator.integers(len(groups), size=len(groups))]
        yield np.concatenate([generator.choice(trials, size=trials.size) for trials in drawn])
