"""Worlds: simulators behind one small interface. NumPy only."""

import dataclasses
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float, Int


@dataclasses.dataclass(frozen=True, kw_only=True)
class VehicleStates:
    """Where N vehicles are and how they move."""

    position: np.ndarray  # [N, 3] m, inertial frame, z up
    attitude: np.ndarray  # [N, 4] unit quaternion (x, y, z, w), body to inertial
    velocity: np.ndarray  # [N, 3] m/s, inertial frame
    body_rate: np.ndarray  # [N, 3] rad/s, body frame
    rotor_speed_rpm: np.ndarray  # [N, 4] rpm


@runtime_checkable
class Simulator(Protocol):
    """N vehicles of one kind, side by side in a simulator; they do not touch each other."""

    def place(self, body: VehicleStates, which: Int[np.ndarray, "K"] | None = None) -> None:
        """Put the vehicles there: all N of them, or those at the K indices `which`, and then `body` holds K.

        Their rotors turn at the speeds `body` gives, and no action is on its way to them.
        """
        ...

    def advance(self, action: Float[np.ndarray, "N 4"]) -> None:
        """Let one control period (0.01 s) pass under actions [N, 4], clipped to [-1, 1]."""
        ...

    def body(self) -> VehicleStates:
        """Where the vehicles are now."""
        ...

    def close(self) -> None:
        """Give the simulator's memory back."""
        ...


def rotation_matrix(attitude: Float[np.ndarray, "N 4"]) -> Float[np.ndarray, "N 3 3"]:
    """The matrices that take vectors from the body to the inertial frame, of unit quaternions (x, y, z, w)."""
    x, y, z, w = np.moveaxis(attitude, -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), -1, 0)


def to_inertial(attitude: Float[np.ndarray, "N 4"], vector: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N 3"]:
    """Vectors of the body frame, seen in the inertial frame."""
    return np.einsum("nij,nj->ni", rotation_matrix(attitude), vector)


def to_body(attitude: Float[np.ndarray, "N 4"], vector: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N 3"]:
    """Vectors of the inertial frame, seen in the body frame."""
    return np.einsum("nji,nj->ni", rotation_matrix(attitude), vector)
