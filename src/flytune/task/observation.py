"""The 17 numbers a controller sees, and their noise (paper R7, R8)."""

from collections.abc import Sequence
from typing import Annotated

import jax
import jax.numpy as jnp
import numpy as np
from annotated_types import Ge, Le, Unit, doc
from jaxtyping import Array, Float

from flytune.config.document import Real
from flytune.config.pytree import pytree
from flytune.physics import rotation
from flytune.physics.components import add, pack, scale, unpack
from flytune.physics.dynamics import State
from flytune.task.reference import Reference
from flytune.task.situation import (
    attitude_error,
    body_rate_error,
    in_heading_frame,
    position_error,
    velocity_error,
)

SIZE = 17
BLOCK_NAMES = ("position_error", "attitude_error", "velocity", "body_rate", "last_action")
BLOCKS = (3, 4, 3, 3, 4)  # numbers in each
RATE = 100  # Hz, at which the noise is given (paper R6)
NOISY = 13  # the first 13 carry noise; the last action does not
LAYOUT = (
    "position_error (3) [m, heading frame], attitude_error (4) [x y z w], velocity (3) [m/s, heading frame], "
    "body_rate (3) [rad/s, body], last_action (4)"
)
# written by version 0.1, whose targets had yaw 0: there the inertial frame is the heading frame
EARLIER_LAYOUTS = (
    "position_error (3) [m], attitude_error (4) [x y z w], velocity (3) [m/s, inertial], "
    "body_rate (3) [rad/s, body], last_action (4)",
)


@pytree
class ObservationNoise:
    """Standard deviations of the Gaussian noise on each block of the observation."""

    position: Annotated[Real, Ge(0), Le(10), Unit("m"), doc("farther from its target than 10 m, a flight has crashed")]
    attitude: Annotated[  # on each of the four quaternion components
        Real, Ge(0), Le(1), Unit("1"), doc("a component of a unit quaternion is at most 1")
    ]
    velocity: Annotated[Real, Ge(0), Le(100), Unit("m/s")]
    body_rate: Annotated[Real, Ge(0), Le(100), Unit("rad/s")]

    def at_rate(self, rate: int) -> "ObservationNoise":
        """The noise at a control rate in Hz: that of sensors with the same noise density as these have at 100 Hz."""
        if rate == RATE:
            return self
        return jax.tree.map(lambda deviation: deviation * (rate / RATE) ** 0.5, self)


def observe(
    target: Reference,
    noise: ObservationNoise,
    state: State,
    last_action: Float[Array, "4"],
    normal: Float[Array, "13"],
) -> Float[Array, "17"]:
    """What the controller sees of a true state: [e_p, q_e, v, w, a_{t-1}].

    Position error and velocity are seen in the heading frame, whose x axis points where the target looks. So a
    controller does the same for every yaw of the target. Of a target that moves, velocity, attitude and body rate are
    relative to those of the target: a controller that hovers then follows it.

    Args:
        target: where to be at this instant, and how it moves.
        noise: standard deviations.
        state: the true state.
        last_action: the action before, in [-1, 1].
        normal: standard normal numbers; zeros give the noise-free observation.

    Source: paper R7, R8. Reading: the quaternion is flipped, then noise is added, then it is normalised.
    """
    numbers = unpack(normal)
    position = add(in_heading_frame(target, position_error(target, state.position)), scale(noise.position, numbers[:3]))
    attitude = rotation.normalise(add(attitude_error(target, state.attitude), scale(noise.attitude, numbers[3:7])))
    velocity = add(
        in_heading_frame(target, velocity_error(target, state.velocity)), scale(noise.velocity, numbers[7:10])
    )
    turning = body_rate_error(target, state.attitude, state.body_rate)
    body_rate = add(turning, scale(noise.body_rate, numbers[10:]))
    return pack((*position, *attitude, *velocity, *body_rate, *unpack(last_action)))


def input_scale(factors: Sequence[float]) -> Float[Array, "17"]:
    """What each number of the observation is multiplied with for a network, from one factor per block."""
    return jnp.asarray(np.repeat(np.asarray(factors, np.float32), BLOCKS))


def draw_noise(key: jax.Array) -> Float[Array, "13"]:
    """Standard normal numbers for one observation."""
    return jax.random.normal(key, (NOISY,))
