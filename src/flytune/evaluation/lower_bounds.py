"""Physical lower bounds: what no controller can beat from a given start, and how near a flight came. NumPy only."""

import numpy as np
from jaxtyping import Bool, Float

from flytune.evaluation.metrics import MINIMUM_STAY, POSITION_BAND


def settling_time_bound(distance: Float[np.ndarray, "N"], speed_bound: float | None) -> Float[np.ndarray, "N"]:
    """Least time in s to bring a trial that starts `distance` m from the target into the band, within the speed bound.

        bound = max(0, |e_p(0)| - 0.02 m) / speed_bound

    0 everywhere without a speed bound (m/s): then nothing is known but that time does not run backwards.

    Source: docs, definitions; paper R14 for the speed bounds.
    """
    if speed_bound is None:
        return np.zeros_like(distance)
    return np.maximum(0.0, distance - POSITION_BAND) / speed_bound


def infeasible(bound: Float[np.ndarray, "N"], duration: float, margins: dict[str, np.ndarray]) -> Bool[np.ndarray, "N"]:
    """Which trials no controller could settle as asked: too far for the duration, or already in violation at the start.

    `bound` and `duration` in s; `margins`: termination name -> [N, T + 1], negative beyond the bound. A start exactly
    on a bound is allowed, as it is in flight.

    Source: docs, definitions; C2 to C4 of the paper's open points.
    """
    too_far = bound > duration - MINIMUM_STAY
    violated = [margin[:, 0] < 0 for margin in margins.values()]
    return np.logical_or.reduce([too_far, *violated])


def efficiency(bound: Float[np.ndarray, "N"], settling_time: Float[np.ndarray, "N"]) -> Float[np.ndarray, "N"]:
    """Physical bound over the measured settling time of the position, 1; above 1 only if the speed bound was broken.

    0 for a trial that never settled (settling time +inf). NaN, left out, where the bound is 0 s: the trial starts
    inside the band, or the task bounds no speed, and there is nothing to be efficient at. A settling time of 0
    belongs to such a start, and is left out with it.

    Source: docs, definitions.
    """
    return np.divide(bound, settling_time, out=np.full_like(bound, np.nan), where=(bound > 0) & (settling_time > 0))
