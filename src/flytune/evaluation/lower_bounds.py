"""Physical lower bounds on the settling time, and how near a flight came to them. NumPy only.

Source: docs, definitions.
"""

import numpy as np
from jaxtyping import Bool, Float

from flytune.evaluation.metrics import MINIMUM_STAY, POSITION_BAND


def settling_time_bound(
    distance: Float[np.ndarray, "N"], speed_bound: float | None, band: float = POSITION_BAND
) -> Float[np.ndarray, "N"]:
    """Least time in s to bring a trial that starts `distance` m from the target into the band, within the speed bound.

        bound = max(0, |e_p(0)| - band) / speed_bound

    0 everywhere without a speed bound (m/s). With distance and band in rad and a body rate bound in rad/s it is the
    bound for the yaw.

    Source: paper R14 for the speed bounds.
    """
    if speed_bound is None:
        return np.zeros_like(distance)
    return np.maximum(0.0, distance - band) / speed_bound


def thrust_bound(
    distance: Float[np.ndarray, "N"],
    forwards: Float[np.ndarray, "N"] | float,
    backwards: Float[np.ndarray, "N"] | float,
) -> Float[np.ndarray, "N"]:
    """Least time in s that any controller takes from rest into the band around the target, to stay there.

    The way to the band, D = distance - POSITION_BAND, is flown with the largest acceleration `forwards` (m/s^2) and
    then with the largest deceleration `backwards` (m/s^2), down to the speed that can still be lost within the width
    of the band:

        v = sqrt(2 backwards 0.04),  vp^2 / (2 forwards) + (vp^2 - v^2) / (2 backwards) = D,
        t = vp / forwards + (vp - v) / backwards

    Attitude and motors are assumed to change at once, so that a real controller always takes longer.
    """
    way = np.maximum(0.0, distance - POSITION_BAND)
    arrival = np.sqrt(2 * np.asarray(backwards) * 2 * POSITION_BAND)
    peak = np.sqrt(
        (way + arrival**2 / (2 * backwards)) / (1 / (2 * np.asarray(forwards)) + 1 / (2 * np.asarray(backwards)))
    )
    brakes = peak > arrival
    return np.where(brakes, peak / forwards + (peak - arrival) / backwards, np.sqrt(2 * way / forwards))


def infeasible(bound: Float[np.ndarray, "N"], duration: float, margins: dict[str, np.ndarray]) -> Bool[np.ndarray, "N"]:
    """Which trials no controller could settle as asked: too far for the duration, or already in violation at the start.

    `bound` and `duration` in s; `margins`: termination name -> [N, T + 1], negative beyond the bound. A start exactly
    on a bound is allowed, as it is in flight.

    Source: C2 to C4 of the paper's open points.
    """
    too_far = bound > duration - MINIMUM_STAY
    violated = [margin[:, 0] < 0 for margin in margins.values()]
    return np.logical_or.reduce([too_far, *violated])


def efficiency(bound: Float[np.ndarray, "N"], settling_time: Float[np.ndarray, "N"]) -> Float[np.ndarray, "N"]:
    """Physical bound over the measured settling time of the position, 1; above 1 only if the speed bound was broken.

    0 for a trial that never settled (settling time +inf). NaN, left out, where the bound is 0 s: the trial starts
    inside the band, or the task has no speed bound. A settling time of 0 belongs to such a start.
    """
    return np.divide(bound, settling_time, out=np.full_like(bound, np.nan), where=(bound > 0) & (settling_time > 0))
