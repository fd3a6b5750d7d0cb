"""Rigid bodies of a model: where they are, and their mass and inertia as one body."""

import dataclasses
import math
from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

INERTIA = ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")
Vector = Float[np.ndarray, "3"]
Matrix = Float[np.ndarray, "3 3"]


@dataclasses.dataclass(frozen=True)
class Pose:
    """A frame in another one."""

    position: Vector = dataclasses.field(default_factory=lambda: np.zeros(3))
    rotation: Matrix = dataclasses.field(default_factory=lambda: np.eye(3))

    @classmethod
    def of(cls, position: Sequence[float], roll_pitch_yaw: Sequence[float] = (0, 0, 0)) -> "Pose":
        """A frame from its place in m, and its angles in rad about the fixed axes x, y, z, as in URDF and SDF."""
        rotation = Rotation.from_euler("xyz", roll_pitch_yaw).as_matrix()
        return cls(np.array(position, float), rotation)

    def __matmul__(self, inner: "Pose") -> "Pose":
        return Pose(self.position + self.rotation @ inner.position, self.rotation @ inner.rotation)

    def inverse(self) -> "Pose":
        """The other frame in this one."""
        return Pose(-self.rotation.T @ self.position, self.rotation.T)


@dataclasses.dataclass(frozen=True)
class Body:
    """A mass in kg, the frame at its centre of mass, and its inertia in kg m^2 about the axes of this frame."""

    mass: float
    frame: Pose
    inertia: Matrix


def inertia_matrix(parts: Mapping[str, float]) -> Matrix:
    """The matrix of its entries `ixx`, `iyy`, `izz`, `ixy`, `ixz`, `iyz`; those that are not there are 0."""
    xx, yy, zz, xy, xz, yz = (parts.get(name, 0.0) for name in INERTIA)
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]], float)


def combined(bodies: Sequence[Body]) -> tuple[float, Vector, Matrix]:
    """Mass, centre of mass, and inertia about it, of bodies that move as one.

    J = sum R_i J_i R_i^T + m_i (|d_i|^2 I - d_i d_i^T), with d_i from the common centre of mass (Steiner).
    """
    mass = math.fsum(body.mass for body in bodies)
    centre = sum((body.mass * body.frame.position for body in bodies), np.zeros(3)) / mass
    total = np.zeros((3, 3))
    for body in bodies:
        from_centre = body.frame.position - centre
        total += body.frame.rotation @ body.inertia @ body.frame.rotation.T
        total += body.mass * (from_centre @ from_centre * np.eye(3) - np.outer(from_centre, from_centre))
    return mass, centre, total
