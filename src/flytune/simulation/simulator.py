"""The simulator protocol, and vehicle states as arrays, in which all simulators take and give them."""

import dataclasses
from collections.abc import Callable
from typing import Any, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from flytune.physics.dynamics import State

WIDTHS = {"position": 3, "attitude": 4, "velocity": 3, "body_rate": 3, "rotor_speed_rpm": 4}  # of a row, in order
WIDTH = sum(WIDTHS.values())  # 17


@dataclasses.dataclass(frozen=True, kw_only=True)
class VehicleStates:
    """The states of N vehicles."""

    position: np.ndarray  # [N, 3] m, inertial frame, z up
    attitude: np.ndarray  # [N, 4] unit quaternion (x, y, z, w), body to inertial
    velocity: np.ndarray  # [N, 3] m/s, inertial frame
    body_rate: np.ndarray  # [N, 3] rad/s, body frame
    rotor_speed_rpm: np.ndarray  # [N, 4] rpm

    @classmethod
    def from_rows(cls, rows: Float[np.ndarray, "*batch 17"]) -> "VehicleStates":
        """The states from one row of numbers each."""
        parts = np.split(rows, np.cumsum(list(WIDTHS.values()))[:-1], axis=-1)
        return cls(**dict(zip(WIDTHS, parts, strict=True)))

    def rows(self) -> Float[np.ndarray, "*batch 17"]:
        """One row of numbers for each vehicle, in the order of `WIDTHS`."""
        return np.concatenate([getattr(self, name) for name in WIDTHS], axis=-1)


@runtime_checkable
class Simulator(Protocol):
    """N vehicles of one kind that do not touch each other."""

    @property
    def physics(self) -> Callable[..., Any] | None:
        """One control period as a function in JAX, (vehicle, State, action) -> State; None where there is none.

        Where there is one, flights and trainings use it alone, with the vehicle of the task.
        """
        ...

    def place(self, states: VehicleStates, which: Int[np.ndarray, "K"] | None = None) -> None:
        """Put the vehicles into states: all N of them, or the K at the indices `which`, and then `states` holds K.

        Their rotors turn at the speeds in `states`, and no delayed action is pending.
        """
        ...

    def advance(self, action: Float[np.ndarray, "N 4"]) -> None:
        """Simulate one control period of the vehicle under actions [N, 4], clipped to [-1, 1]."""
        ...

    def states(self) -> VehicleStates:
        """The states of the vehicles now."""
        ...

    def close(self) -> None:
        """Free the memory of the simulator."""
        ...


def state_numbers(state: State) -> Float[Array, "17 *batch"]:
    """A state as one array, one number of every vehicle after the other; pending actions are left out."""
    return jnp.stack([number for name in WIDTHS for number in getattr(state, name)])


def state_from(numbers: Float[Array, "17 *batch"], pending_actions: jax.Array) -> State:
    """The state whose numbers these are, with its pending actions [latency, 4, ...]."""
    parts, first = {}, 0
    for name, width in WIDTHS.items():
        parts[name] = tuple(numbers[first : first + width])
        first += width
    return State(**parts, pending_actions=pending_actions)


def rotation_matrix(attitude: Float[np.ndarray, "N 4"]) -> Float[np.ndarray, "N 3 3"]:
    """The matrices that take vectors from the body to the inertial frame, of unit quaternions (x, y, z, w)."""
    x, y, z, w = np.moveaxis(attitude, -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), -1, 0)


def quaternion_product(
    attitude: Float[np.ndarray, "N 4"], vector: Float[np.ndarray, "N 3"]
) -> Float[np.ndarray, "N 4"]:
    """Quaternions (x, y, z, w) times vectors as quaternions without a real part: q (v, 0)."""
    axis, real = attitude[:, :3], attitude[:, 3:]
    turned = np.cross(axis, vector) + real * vector
    return np.concatenate([turned, -np.sum(axis * vector, axis=-1, keepdims=True)], axis=-1)


def rotate_attitude(attitude: Float[np.ndarray, "N 4"], matrix: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "N 4"]:
    """The attitudes (x, y, z, w) after a further turn in the body's own frame, given as a rotation matrix."""
    if np.array_equal(matrix, np.eye(3)):
        return attitude
    from scipy.spatial.transform import Rotation  # late, because it is slow to import

    return (Rotation.from_quat(attitude) * Rotation.from_matrix(matrix)).as_quat()


def to_inertial(attitude: Float[np.ndarray, "N 4"], vector: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N 3"]:
    """Vectors of the body frame, seen in the inertial frame."""
    return np.einsum("nij,nj->ni", rotation_matrix(attitude), vector)


def to_body(attitude: Float[np.ndarray, "N 4"], vector: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N 3"]:
    """Vectors of the inertial frame, seen in the body frame."""
    return np.einsum("nji,nj->ni", rotation_matrix(attitude), vector)
