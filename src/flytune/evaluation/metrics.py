"""Step-response metrics: one number per trial from its error over time, in NumPy.

An error [N, K] is a value less its target: N trials of K = T + 1 samples at the control rate, the start (sample 0)
and the end included. Its unit is the unit of the metric: m, or rad for yaw.

Source: docs, definitions.
"""

import math

import numpy as np
from jaxtyping import Bool, Float

from flytune.task.situation import POSITION_BAND as POSITION_BAND
from flytune.task.situation import YAW_BAND as YAW_BAND

SMALL_STEP = 0.1  # m; a shorter step has no meaningful overshoot or rise time
SMALL_TURN = math.pi / 10  # rad; the same for yaw, 18 deg
MINIMUM_STAY = 0.5  # s in the band before the end, for a trial to count as settled
STEADY_WINDOW = 2.0  # s before the end over which the steady state is averaged


def yaw_angle(attitude: Float[np.ndarray, "*batch 4"]) -> Float[np.ndarray, "*batch"]:
    """ZYX yaw in [-pi, pi] rad of quaternions (x, y, z, w), body to inertial.

        yaw = atan2(2 (w z + x y), w^2 + x^2 - y^2 - z^2)

    Both arguments scale with the squared norm, so that a quaternion rounded to single precision keeps its yaw.

    Source: Diebel, Representing Attitude (2006), eq. 290.
    """
    x, y, z, w = np.moveaxis(attitude, -1, 0)
    return np.arctan2(2 * (w * z + x * y), w**2 + x**2 - y**2 - z**2)


def wrap_angle(angle: Float[np.ndarray, "*batch"]) -> Float[np.ndarray, "*batch"]:
    """The same direction in [-pi, pi] rad; what lies in there already is returned to the bit."""
    return angle - 2 * math.pi * np.round(angle / (2 * math.pi))


def circular_mean(angle: Float[np.ndarray, "*batch K"]) -> Float[np.ndarray, "*batch"]:
    """Direction in [-pi, pi] rad of the mean unit vector over the last axis: atan2(mean sin, mean cos)."""
    return np.arctan2(np.sin(angle).mean(axis=-1), np.cos(angle).mean(axis=-1))


def unwrapped_yaw_error(yaw: Float[np.ndarray, "N K"], target: float) -> Float[np.ndarray, "N K"]:
    """Yaw error in rad without jumps, against the target's multiple of 360 deg nearest the final value.

    A yaw that turns the long way round, or once too often, keeps the whole turn as its step.
    """
    error = np.unwrap(yaw, axis=-1) - target
    return error - 2 * math.pi * np.round(error[:, -1:] / (2 * math.pi))


def error_along_start(error: Float[np.ndarray, "N K 3"]) -> Float[np.ndarray, "N K"]:
    """Component of a position error along the direction of the start, in m; negative past the target.

        along(t) = e(t) . e(0) / |e(0)|

    Zero where the trial starts on the target, which then has no direction.
    """
    start = error[:, 0]
    distance = np.linalg.norm(start, axis=-1, keepdims=True)
    direction = np.divide(start, distance, out=np.zeros_like(start), where=distance > 0)
    return np.einsum("nki,ni->nk", error, direction)


def settling_time(
    error: Float[np.ndarray, "N K"], time: Float[np.ndarray, "K"], band: float | Float[np.ndarray, "N"]
) -> Float[np.ndarray, "N"]:
    """First instant in s after which |error| <= band to the end of the trial; 0 if it never left; +inf unless settled.

    Settled means in the band from at least MINIMUM_STAY before the end. `band` may differ between trials.
    """
    outside = ~(np.abs(error) <= np.reshape(band, (-1, 1)))  # so that a NaN is outside
    samples = time.size
    entered = np.where(outside.any(axis=1), samples - np.argmax(outside[:, ::-1], axis=1), 0)
    instant = time[np.minimum(entered, samples - 1)]
    early_enough = instant <= time[-1] - MINIMUM_STAY + _half_sample(time)
    return np.where((entered < samples) & early_enough, instant, np.inf)


def rise_time(error: Float[np.ndarray, "N K"], time: Float[np.ndarray, "K"]) -> Float[np.ndarray, "N"]:
    """Time in s from 10 % to 90 % of the step: from the first error of 0.9 to the first of 0.1 of the initial one.

    Measured towards the target and on samples, not interpolated. +inf if 90 % is never reached; NaN without a step.
    """
    step = np.abs(error[:, :1])
    remaining = error * np.sign(error[:, :1])
    begun, arrived = remaining <= 0.9 * step, remaining <= 0.1 * step
    elapsed = time[np.argmax(arrived, axis=1)] - time[np.argmax(begun, axis=1)]  # the first sample of each
    elapsed = np.where(arrived.any(axis=1), np.round(elapsed, 9), np.inf)  # 0.94 rather than 0.9400000000000001
    return np.where(step[:, 0] > 0, elapsed, np.nan)


def overshoot(error: Float[np.ndarray, "N K"], band: float = 0.0) -> Float[np.ndarray, "N"]:
    """Largest excursion past the target as a fraction of the step; 0 if it is inside the band; NaN without a step.

        overshoot = max over t of (-e(t) sign(e(0))) / |e(0)|

    The band decides whether an excursion counts, and is not taken off one that does.
    """
    step = np.abs(error[:, 0])
    excursion = np.max(-error * np.sign(error[:, :1]), axis=1)
    excursion = np.where(excursion > band, excursion, 0.0)
    return np.divide(excursion, step, out=np.full_like(step, np.nan), where=step > 0)


def steady_state_error(error: Float[np.ndarray, "N K"], time: Float[np.ndarray, "K"]) -> Float[np.ndarray, "N"]:
    """|mean error| over the last STEADY_WINDOW (the whole trial if it is shorter), in the unit of the error."""
    return np.abs(error[:, steady_samples(time)].mean(axis=1))


def steady_state_yaw_error(error: Float[np.ndarray, "N K"], time: Float[np.ndarray, "K"]) -> Float[np.ndarray, "N"]:
    """|circular mean error| over the last STEADY_WINDOW, in rad; any multiple of 360 deg may be on the error."""
    return np.abs(circular_mean(error[:, steady_samples(time)]))


def steady_state_position_error(
    error: Float[np.ndarray, "N K 3"], time: Float[np.ndarray, "K"]
) -> Float[np.ndarray, "N"]:
    """Norm of the mean error vector over the last STEADY_WINDOW, in m."""
    return np.linalg.norm(error[:, steady_samples(time)].mean(axis=1), axis=-1)


def rms_error(error: Float[np.ndarray, "N K"], time: Float[np.ndarray, "K"]) -> Float[np.ndarray, "N"]:
    """Root mean square error over the last STEADY_WINDOW: sees the oscillation that a mean hides."""
    return np.sqrt(np.square(error[:, steady_samples(time)]).mean(axis=1))


def itae(error: Float[np.ndarray, "N K"], time: Float[np.ndarray, "K"]) -> Float[np.ndarray, "N"]:
    """Integral of t |e(t)| dt over the trial (trapezoids), in m s^2 or rad s^2.

    Source: Graham and Lathrop, The synthesis of "optimum" transient response (1953).
    """
    return np.trapezoid(time * np.abs(error), time, axis=1)


def peak_speed(velocity: Float[np.ndarray, "N K 3"]) -> Float[np.ndarray, "N"]:
    """Largest speed in m/s of each trial; +inf if it was not finite at some sample."""
    with np.errstate(over="ignore", invalid="ignore"):
        speed = np.linalg.norm(velocity, axis=-1)
    return np.where(np.isfinite(speed), speed, np.inf).max(axis=1)


def action_rms(action: Float[np.ndarray, "N K 4"]) -> Float[np.ndarray, "N"]:
    """Root mean square action over the flown steps and the motors, 1; sample 0 is the hover before the first action."""
    return np.sqrt(np.square(action[:, 1:]).mean(axis=(1, 2)))


def action_total_variation(action: Float[np.ndarray, "N K 4"]) -> Float[np.ndarray, "N"]:
    """Mean |a_t - a_{t-1}| per step and motor, 1; the first step counts from hover (paper R7: a_{-1} = 0)."""
    return np.abs(np.diff(action, axis=1)).mean(axis=(1, 2))


def steady_samples(time: Float[np.ndarray, "K"]) -> Bool[np.ndarray, "K"]:
    """Which samples are the last STEADY_WINDOW, its start excluded: 200 at 100 Hz; whole periods average out."""
    return time > time[-1] - STEADY_WINDOW + _half_sample(time)


def _half_sample(time: Float[np.ndarray, "K"]) -> float:
    """Half a sampling interval in s: comparing instants with it to spare makes their rounding harmless."""
    return 0.5 * float(time[-1] - time[0]) / max(time.size - 1, 1)
