"""The reference: where a vehicle is to be at an instant, and what a path asks of it there.

A quadrotor is differentially flat: position and heading over time determine attitude and body rate. A controller sees
its state relative to these. So one that was made to hover also follows a path.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from flytune.config.pytree import pytree, static
from flytune.physics import rotation
from flytune.physics.components import Components


@pytree
class Motion:
    """How a reference moves; vectors as tuples of scalars."""

    velocity: Components  # 3, m/s, inertial frame
    attitude: Components  # 4, unit quaternion (x, y, z, w), body to inertial
    body_rate: Components  # 3, rad/s, in the body frame of the reference


@pytree
class Reference:
    """Position and heading of a target at an instant, and its motion; None of one that rests, level."""

    position: Components  # 3, m, inertial frame, z up
    yaw: Any  # rad
    motion: Motion | None = None


@pytree
class Path:
    """What all paths have in common. Each gives its `place` and `heading` at a time; the rest is derived from them."""

    feed_forward: bool = static(default=True)  # attitude and body rate are seen relative to those the path needs

    def place(self, time: Any, xp: Any = jnp) -> Components:
        """The position in m at a time in s, with the functions of NumPy or of JAX."""
        raise NotImplementedError

    def heading(self, time: Any, xp: Any = jnp) -> Any:
        """The yaw in rad at a time in s."""
        raise NotImplementedError

    def reference(self, time: Any, gravity: Any) -> Reference:
        """The reference at a time in s, under a gravity in m/s^2.

        The thrust carries the weight and accelerates the vehicle along the path. Without drag, the z axis of the body
        then points along a + g e_z. Its yaw is the heading. The body rate is that of this attitude over time.

        Source: Mellinger and Kumar, "Minimum snap trajectory generation and control for quadrotors", ICRA 2011,
        section III, with yaw as the first of the ZYX angles.
        """
        time = jnp.asarray(time, float)
        velocity = _rate(self.place)

        def attitude(time: Any) -> Components:
            yaw = jnp.asarray(self.heading(time), float)
            if not self.feed_forward:
                return rotation.from_euler(jnp.zeros(()), jnp.zeros(()), yaw)
            ax, ay, az = _rate(velocity)(time)
            c, s = jnp.cos(yaw), jnp.sin(yaw)
            forward, left, up = c * ax + s * ay, c * ay - s * ax, az + gravity
            pitch = jnp.arctan2(forward, up)
            roll = jnp.arctan2(-left, jnp.sqrt(forward * forward + up * up))
            return rotation.from_euler(roll, pitch, yaw)

        now, change = attitude(time), _rate(attitude)(time)
        x, y, z, _ = rotation.multiply(rotation.conjugate(now), change)
        motion = Motion(velocity=velocity(time), attitude=now, body_rate=(2 * x, 2 * y, 2 * z))
        return Reference(position=self.place(time), yaw=self.heading(time), motion=motion)


def _rate(function: Callable[[Any], Components]) -> Callable[[Any], Components]:
    """The derivative of a function of time."""
    return lambda time: jax.jvp(function, (time,), (jnp.ones_like(time),))[1]
