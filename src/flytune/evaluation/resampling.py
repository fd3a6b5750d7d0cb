"""A log on the 100 Hz of the judge: linear interpolation of numbers, spherical interpolation of attitudes.

The error of linear interpolation over a step h is at most h^2 / 8 times the largest second derivative: at 50 Hz and
5 m/s^2 it is 0.25 mm, at 10 Hz 6 mm. It is estimated from the log itself and told.

Source: de Boor, A Practical Guide to Splines (1978), chapter III; Shoemake, Animating rotation with quaternion curves
(1985), for attitudes.
"""

import dataclasses

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation, Slerp

from flytune.errors import BadInput
from flytune.evaluation.metrics import STEADY_WINDOW
from flytune.physics.dynamics import CONTROL_PERIOD

LONGEST_GAP = 0.25  # s without a sample over which is interpolated, unless the user gives another
EXACT = 1e-6  # s; samples that are nearer than this to the judge's are taken as they are


@dataclasses.dataclass(frozen=True)
class Grid:
    """The instants of the judge, from the start of one flight to its end."""

    where: str  # the flight in messages
    start: float  # s, on the clock of the log
    time: Float[np.ndarray, "K"]  # s since the start
    longest_gap: float  # s

    def numbers(self, name: str, time: Float[np.ndarray, "L"], values: np.ndarray) -> np.ndarray:
        """Values [L, ...] of a log at the instants of the judge; rows with a NaN are left out.

        Raises:
            BadInput: fewer than two rows are left, or a gap is too long.
        """
        flat = values.reshape(len(values), -1)
        seen, flat = self._seen(name, time, flat)
        if self._exact(seen):
            return flat[: self.time.size].reshape(-1, *values.shape[1:])
        parts = [np.interp(self.time, seen, column) for column in flat.T]
        return np.stack(parts, axis=-1).reshape(-1, *values.shape[1:])

    def attitudes(self, time: Float[np.ndarray, "L"], attitude: Float[np.ndarray, "L 4"]) -> Float[np.ndarray, "K 4"]:
        """Quaternions (x, y, z, w) at the instants of the judge.

        Raises:
            BadInput: see `numbers`; or a quaternion without a direction.
        """
        seen, attitude = self._seen("attitude", time, attitude)
        norms = np.linalg.norm(attitude, axis=-1)
        if (off := np.abs(norms - 1) > 0.1).any():
            at = int(np.argmax(off))
            raise BadInput(
                f"{self.where}: the quaternion at {seen[at]:.2f} s has the norm {norms[at]:.3g}. Allowed: 1. Name its "
                "columns in their order: --columns qx=COLUMN qy=COLUMN qz=COLUMN qw=COLUMN."
            )
        if self._exact(seen):
            return attitude[: self.time.size]
        inside = np.clip(self.time, seen[0], seen[-1])
        return Slerp(seen, Rotation.from_quat(attitude))(inside).as_quat()

    def error(self, time: Float[np.ndarray, "L"], values: Float[np.ndarray, "L"]) -> float:
        """The largest error of linear interpolation between the samples, estimated from their second differences."""
        seen, flat = self._seen("position", time, values[:, None])
        if self._exact(seen) or seen.size < 3:
            return 0.0
        step = np.diff(seen)
        slope = np.diff(flat[:, 0]) / step
        second = 2 * np.abs(np.diff(slope)) / (step[1:] + step[:-1])
        return float(np.max(second * np.maximum(step[1:], step[:-1]) ** 2 / 8))

    def _seen(self, name: str, time: np.ndarray, flat: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        kept = np.isfinite(flat).all(axis=1) & np.isfinite(time)
        seen, flat = time[kept] - self.start, flat[kept]
        if seen.size < 2:
            raise BadInput(f"{self.where}: {name} has {seen.size} samples. Allowed: 2 or more.")
        edges = np.concatenate([[min(0.0, seen[0])], seen, [max(self.time[-1], seen[-1])]])
        gaps = np.diff(edges)
        longest = int(np.argmax(gaps))
        if gaps[longest] > self.longest_gap * (1 + 1e-9):
            raise BadInput(
                f"{self.where}: {name} has no sample from {edges[longest]:.2f} to {edges[longest + 1]:.2f} s after the "
                f"start ({gaps[longest]:.2f} s). Allowed: {self.longest_gap:g} s. Give --gap {_up(gaps[longest]):g} to "
                "interpolate over it."
            )
        return seen, flat

    def _exact(self, seen: np.ndarray) -> bool:
        return seen.size >= self.time.size and bool(np.all(np.abs(seen[: self.time.size] - self.time) < EXACT))


def make_grid(where: str, time: Float[np.ndarray, "L"], start: float, end: float, longest_gap: float) -> Grid:
    """The instants of the judge, in s on the clock of the log.

    Args:
        where: the beginning of a message.
        time: of the samples in s.
        start: of the flight in s.
        end: of the flight in s.
        longest_gap: between two samples in s, beyond which nothing is interpolated.

    Raises:
        BadInput: the flight is shorter than the window of the steady state.
    """
    duration = end - start
    if not duration >= STEADY_WINDOW - 1e-6:
        raise BadInput(
            f"{where}: lasts {max(duration, 0.0):.2f} s after its start. Allowed: {STEADY_WINDOW:g} s or more, since "
            "the steady state is the mean of that time. Log longer, or give an earlier --start."
        )
    samples = int(duration / CONTROL_PERIOD + 1e-4) + 1
    return Grid(where, start, np.arange(samples) * CONTROL_PERIOD, longest_gap)


def _up(gap: float) -> float:
    return np.ceil(gap * 100 + 1e-6) / 100
