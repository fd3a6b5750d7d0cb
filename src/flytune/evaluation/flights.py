"""Flights: recorded trajectories, all a judge ever sees of a controller. NumPy only."""

import dataclasses
import io
from pathlib import Path
from typing import Any

import numpy as np

from flytune.config.files import write_bytes

STATE_COLUMNS = {
    "position": ("x", "y", "z"),
    "attitude": ("qx", "qy", "qz", "qw"),
    "velocity": ("vx", "vy", "vz"),
    "body_rate": ("wx", "wy", "wz"),
    "rotor_speed_rpm": ("rpm0", "rpm1", "rpm2", "rpm3"),
    "action": ("a0", "a1", "a2", "a3"),
}
COLUMN_UNITS = {"position": "m", "attitude": "1", "velocity": "m/s", "body_rate": "rad/s", "rotor_speed_rpm": "rpm",
                "action": "1"}  # fmt: skip


@dataclasses.dataclass(frozen=True, kw_only=True)
class Flights:
    """True trajectories of N trials, sampled at the control rate from the start (sample 0) to the end, T + 1 samples.

    A trial that crashed (left a ball of 10 m around the target, or stopped being finite) holds its last state from
    there on; `crashed` says which ones did.
    """

    time: np.ndarray  # [T + 1] s, from 0, evenly spaced
    position: np.ndarray  # [N, T + 1, 3] m, inertial frame, z up
    attitude: np.ndarray  # [N, T + 1, 4] unit quaternion (x, y, z, w), body to inertial
    velocity: np.ndarray  # [N, T + 1, 3] m/s, inertial frame
    body_rate: np.ndarray  # [N, T + 1, 3] rad/s, body frame
    rotor_speed_rpm: np.ndarray  # [N, T + 1, 4] rpm
    action: np.ndarray  # [N, T + 1, 4] in [-1, 1]; sample k is the action that led to sample k, sample 0 is hover (0)
    crashed: np.ndarray  # [N] bool
    margins: dict[str, np.ndarray]  # termination name -> [N, T + 1], share of the bound left, negative beyond it
    target_position: np.ndarray  # [3] m
    target_yaw: float  # rad
    speed_bound: float | None  # m/s, of the task's speed termination; None where it has none
    name: str  # the controller, as the user named it
    task: str
    vehicle: str
    simulator: str
    seed: int
    initial_conditions: str  # "clear" or "paper"

    def __repr__(self) -> str:
        crashed = f", {np.count_nonzero(self.crashed)} crashed" if self.crashed.any() else ""
        return (
            f"Flights({self.name or 'controller'} on {self.task}, {self.trials} trials of {self.duration:g} s{crashed})"
        )

    @property
    def trials(self) -> int:
        """Number of trials N."""
        return self.position.shape[0]

    @property
    def duration(self) -> float:
        """Length of each trial in seconds."""
        return float(self.time[-1])

    def save(self, path: Path) -> None:
        """Write the trajectories as .npz: `data` [N, T + 1, C] with `columns` [C], `units` [C] and labels.

        Raises:
            BadInput: the file cannot be written.
        """
        content = io.BytesIO()
        np.savez_compressed(content, **self._arrays())
        write_bytes(path, content.getvalue(), "flights")

    def _arrays(self) -> dict[str, Any]:
        blocks = [np.broadcast_to(self.time[None, :, None], (*self.position.shape[:2], 1))]
        columns, units = ["time"], ["s"]
        for field, names in STATE_COLUMNS.items():
            blocks.append(getattr(self, field))
            columns += names
            units += [COLUMN_UNITS[field]] * len(names)
        for name, margin in self.margins.items():
            blocks.append(margin[..., None])
            columns.append(f"margin_{name}")
            units.append("1")
        return {
            "data": np.concatenate(blocks, axis=-1).astype(np.float32),
            "columns": np.array(columns),
            "units": np.array(units),
            "crashed": self.crashed,
            "target_position": self.target_position,
            "target_yaw": self.target_yaw,
            "who": self.name,
            "task": self.task,
            "vehicle": self.vehicle,
            "world": self.simulator,
            "seed": self.seed,
            "starts": self.initial_conditions,
        }
