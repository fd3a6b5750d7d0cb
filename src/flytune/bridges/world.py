"""Worlds: simulators that are not ours, behind one small interface. NumPy only."""

import dataclasses
from typing import Protocol

import numpy as np


@dataclasses.dataclass(frozen=True, kw_only=True)
class Body:
    """Where N vehicles are and how they move."""

    position: np.ndarray  # [N, 3] m, inertial frame, z up
    attitude: np.ndarray  # [N, 4] unit quaternion (x, y, z, w), body to inertial
    velocity: np.ndarray  # [N, 3] m/s, inertial frame
    body_rate: np.ndarray  # [N, 3] rad/s, body frame
    rotor_speed_rpm: np.ndarray  # [N, 4] rpm


class World(Protocol):
    """N vehicles of one kind, side by side in a simulator; they do not touch each other."""

    def place(self, body: Body, which: np.ndarray | None = None) -> None:
        """Put the vehicles (those at the indices `which`, all where None) there, their actuators at rest."""
        ...

    def advance(self, action: np.ndarray) -> None:
        """Let one control period (0.01 s) pass under actions [N, 4], clipped to [-1, 1]."""
        ...

    def body(self) -> Body:
        """Where the vehicles are now."""
        ...

    def close(self) -> None:
        """Give the simulator's memory back."""
        ...
