"""The observation as a classical controller uses it: the 17 numbers by their parts, in the target's heading frame."""

from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from flytune.config.pytree import pytree
from flytune.physics import rotation
from flytune.physics.components import Components, unpack


@pytree
class Sensed:
    """A noisy observation by its parts; vectors as tuples of scalars."""

    position_error: Components  # 3, m, p - p*, heading frame
    attitude: Components  # 4, unit quaternion (x, y, z, w), body to heading frame; the target's yaw is 0 there
    velocity: Components  # 3, m/s, heading frame
    body_rate: Components  # 3, rad/s, body frame
    last_action: Components  # 4, in [-1, 1]


def sense(observation: Float[Array, "17"]) -> Sensed:
    """The parts of an observation."""
    numbers = unpack(observation)
    return Sensed(
        position_error=numbers[:3],
        attitude=numbers[3:7],
        velocity=numbers[7:10],
        body_rate=numbers[10:13],
        last_action=numbers[13:],
    )


def heading(attitude: Components) -> Any:
    """The yaw of the ZYX Euler angles in rad, [-pi, pi]."""
    x, y, z, w = attitude
    return jnp.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


def wrapped(angle: Any) -> Any:
    """The same angle in [-pi, pi]."""
    return jnp.arctan2(jnp.sin(angle), jnp.cos(angle))


def body_axes(attitude: Components) -> tuple[Components, Components, Components]:
    """The body's x, y and z axes seen in the frame of the attitude: the columns of R(q)."""
    x, y, z, w = attitude
    forward = (1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y))
    left = (2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x))
    return forward, left, rotation.vertical_axis(attitude)


def dot(first: Components, second: Components) -> Any:
    """The scalar product."""
    return sum((a * b for a, b in zip(first, second, strict=True)), start=jnp.zeros(()))
