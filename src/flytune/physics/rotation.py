"""Quaternion algebra on (x, y, z, w), Hamilton convention, body to inertial (paper R2), on tuples of scalars."""

from typing import Any

import jax.numpy as jnp

from flytune.physics.components import Components, add, cross, scale, squared_norm


def multiply(first: Components, second: Components) -> Components:
    """The Hamilton product first (x) second: the rotation `second`, then `first`."""
    x1, y1, z1, w1 = first
    x2, y2, z2, w2 = second
    return (
        w1 * x2 + x1 * w2 + y1 * z2 - z1 * y2,
        w1 * y2 - x1 * z2 + y1 * w2 + z1 * x2,
        w1 * z2 + x1 * y2 - y1 * x2 + z1 * w2,
        w1 * w2 - x1 * x2 - y1 * y2 - z1 * z2,
    )


def conjugate(quaternion: Components) -> Components:
    """The inverse rotation of a unit quaternion."""
    x, y, z, w = quaternion
    return -x, -y, -z, w


def normalise(quaternion: Components) -> Components:
    """The unit quaternion of the same direction; the argument must not be zero."""
    return scale(1 / jnp.sqrt(squared_norm(quaternion)), quaternion)


def exponential(rotation: Components) -> Components:
    """The unit quaternion of a rotation vector in radians: (sin(|r|/2) r / |r|, cos(|r|/2)).

    As a series in |r|^2, which needs no square root and has a gradient at zero; exact in float32 up to |r| = 1 rad,
    a hundred times what a vehicle turns in one physics step.
    """
    squared = squared_norm(rotation) / 4
    sine = 0.5 * (1 - squared / 6 * (1 - squared / 20 * (1 - squared / 42)))
    cosine = 1 - squared / 2 * (1 - squared / 12 * (1 - squared / 30 * (1 - squared / 56)))
    return (*scale(sine, rotation), cosine)


def rotate(quaternion: Components, vector: Components) -> Components:
    """A vector of three, turned by a unit quaternion: v + 2 w (u x v) + 2 u x (u x v), u its vector part."""
    axis, w = quaternion[:3], quaternion[3]
    turned = scale(2, cross(axis, vector))
    return add(vector, scale(w, turned), cross(axis, turned))


def vertical_axis(quaternion: Components) -> Components:
    """The body's z axis in the inertial frame, R(q) [0, 0, 1]: the direction of the thrust."""
    x, y, z, w = quaternion
    return 2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)


def shortest(quaternion: Components) -> Components:
    """The one of q and -q, both the same rotation, whose real part is not negative (paper R7)."""
    return scale(jnp.where(quaternion[3] < 0, -1.0, 1.0), quaternion)


def from_euler(roll: Any, pitch: Any, yaw: Any) -> Components:
    """The quaternion of ZYX Euler angles in radians: yaw about z, then pitch about y, then roll about x."""
    zero = jnp.zeros(())
    about_x = (jnp.sin(roll / 2), zero, zero, jnp.cos(roll / 2))
    about_y = (zero, jnp.sin(pitch / 2), zero, jnp.cos(pitch / 2))
    about_z = (zero, zero, jnp.sin(yaw / 2), jnp.cos(yaw / 2))
    return multiply(multiply(about_z, about_y), about_x)


def angle(quaternion: Components) -> Any:
    """The geodesic angle 2 atan2(|vec q|, |w|) in [0, pi]; its gradient at zero is zero, not NaN (paper R10)."""
    x, y, z, w = quaternion
    return 2 * jnp.arctan2(safe_norm((x, y, z)), jnp.abs(w))


def roll_pitch(quaternion: Components) -> tuple[Any, Any]:
    """Roll in [-pi, pi] and pitch in [-pi/2, pi/2], in radians, of the ZYX Euler angles."""
    x, y, z, w = quaternion
    roll = jnp.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    return roll, jnp.arcsin(jnp.clip(2 * (w * y - z * x), -1.0, 1.0))


def safe_norm(vector: Components) -> Any:
    """The Euclidean norm, with gradient 0 instead of NaN at the origin."""
    squared = squared_norm(vector)
    nonzero = squared != 0  # true of NaN, which must stay NaN
    return jnp.where(nonzero, jnp.sqrt(jnp.where(nonzero, squared, 1.0)), 0.0)
