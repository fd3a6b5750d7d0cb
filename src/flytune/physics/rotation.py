"""Quaternion algebra on (x, y, z, w), Hamilton convention, body to inertial (paper R2)."""

import jax.numpy as jnp
from jaxtyping import Array, Float

Quaternion = Float[Array, "4"]
Vector3 = Float[Array, "3"]


def multiply(first: Quaternion, second: Quaternion) -> Quaternion:
    """The Hamilton product first (x) second: the rotation `second`, then `first`."""
    x1, y1, z1, w1 = first
    x2, y2, z2, w2 = second
    return jnp.stack(
        [
            w1 * x2 + x1 * w2 + y1 * z2 - z1 * y2,
            w1 * y2 - x1 * z2 + y1 * w2 + z1 * x2,
            w1 * z2 + x1 * y2 - y1 * x2 + z1 * w2,
            w1 * w2 - x1 * x2 - y1 * y2 - z1 * z2,
        ]
    )


def conjugate(quaternion: Quaternion) -> Quaternion:
    """The inverse rotation of a unit quaternion."""
    return quaternion * jnp.array([-1.0, -1.0, -1.0, 1.0])


def normalise(quaternion: Quaternion) -> Quaternion:
    """The unit quaternion of the same direction; the argument must not be zero."""
    return quaternion / jnp.sqrt(jnp.sum(quaternion**2))


def rotate(quaternion: Quaternion, vector: Vector3) -> Vector3:
    """A body vector seen in the inertial frame: R(q) v."""
    axis, real = quaternion[:3], quaternion[3]
    twice_cross = 2 * jnp.cross(axis, vector)
    return vector + real * twice_cross + jnp.cross(axis, twice_cross)


def vertical_axis(quaternion: Quaternion) -> Vector3:
    """The body's z axis seen in the inertial frame, R(q) [0, 0, 1]: where thrust points."""
    x, y, z, w = quaternion
    return jnp.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x**2 + y**2)])


def shortest(quaternion: Quaternion) -> Quaternion:
    """The one of q and -q, both the same rotation, whose real part is not negative (paper R7)."""
    return jnp.where(quaternion[3] < 0, -quaternion, quaternion)


def angle(quaternion: Quaternion) -> Float[Array, ""]:
    """The geodesic angle 2 atan2(|vec q|, |w|) in [0, pi]; its gradient at zero is zero, not NaN (paper R10)."""
    return 2 * jnp.arctan2(safe_norm(quaternion[:3]), jnp.abs(quaternion[3]))


def from_euler(roll: Float[Array, ""], pitch: Float[Array, ""], yaw: Float[Array, ""]) -> Quaternion:
    """The quaternion of ZYX Euler angles in radians: yaw about z, then pitch about y, then roll about x."""
    cr, sr = jnp.cos(roll / 2), jnp.sin(roll / 2)
    cp, sp = jnp.cos(pitch / 2), jnp.sin(pitch / 2)
    cy, sy = jnp.cos(yaw / 2), jnp.sin(yaw / 2)
    return jnp.stack(
        [
            sr * cp * cy - cr * sp * sy,
            cr * sp * cy + sr * cp * sy,
            cr * cp * sy - sr * sp * cy,
            cr * cp * cy + sr * sp * sy,
        ]
    )


def roll_pitch_yaw(quaternion: Quaternion) -> Vector3:
    """ZYX Euler angles in radians: roll and yaw in [-pi, pi], pitch in [-pi/2, pi/2]."""
    x, y, z, w = quaternion
    roll = jnp.arctan2(2 * (w * x + y * z), 1 - 2 * (x**2 + y**2))
    pitch = jnp.arcsin(jnp.clip(2 * (w * y - z * x), -1.0, 1.0))
    yaw = jnp.arctan2(2 * (w * z + x * y), 1 - 2 * (y**2 + z**2))
    return jnp.stack([roll, pitch, yaw])


def safe_norm(vector: Float[Array, "n"]) -> Float[Array, ""]:
    """The Euclidean norm, with gradient 0 instead of NaN at the origin."""
    squared = jnp.sum(vector**2)
    positive = squared > 0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, squared, 1.0)), 0.0)
