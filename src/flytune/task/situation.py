"""The situation: how far a vehicle is from its target, worked out once and read by rewards and terminations alike."""

import math
from typing import Annotated

import jax.numpy as jnp
from annotated_types import Ge, Le, Unit, doc
from jaxtyping import Array, Float

from flytune.config.document import Real
from flytune.config.pytree import pytree
from flytune.physics import rotation
from flytune.physics.components import Components, unpack
from flytune.physics.dynamics import State

# m; on x, y, z and on the distance to the target: within it, a response counts as settled. The paper says 2 % and not
# of what; this is 2 % of the target's height of 1 m (C5)
POSITION_BAND = 0.02
YAW_BAND = 0.02 * math.pi  # rad; 2 % of 180 deg


Metres = Annotated[
    Real, Ge(-1000), Le(1000), Unit("m"), doc("positions are single precision, coarser than 0.1 mm farther out")
]


@pytree
class Target:
    """Where to hover: a position and a heading, level and at rest (paper R19: (0, 0, 1) m, zero attitude)."""

    position: tuple[Metres, Metres, Metres]
    yaw: Annotated[Real, Ge(-2 * math.pi), Le(2 * math.pi), Unit("rad"), doc("a full turn either way")]


@pytree
class Situation:
    """One vehicle, seen from its target; vectors as tuples of scalars."""

    position_error: Components  # 3, m, p - p*
    attitude_error: Components  # 4, conj(q*) (x) q, real part not negative
    velocity: Components  # 3, m/s, inertial frame
    body_rate: Components  # 3, rad/s, body frame
    altitude: Float[Array, ""]  # m, z
    roll: Float[Array, ""]  # rad
    pitch: Float[Array, ""]  # rad
    action_change: Components  # 4, a_t - a_{t-1}


def position_error(target: Target, position: Components) -> Components:
    """The way from the target to the vehicle in metres, e_p = p - p* (reading of R7)."""
    return tuple(here - wanted for here, wanted in zip(position, target.position, strict=True))


def attitude_error(target: Target, attitude: Components) -> Components:
    """The rotation from the target's attitude to the vehicle's, conj(q*) (x) q, flipped to w >= 0 (reading of R7)."""
    half = jnp.asarray(target.yaw) / 2
    zero = jnp.zeros(())
    wanted = (zero, zero, jnp.sin(half), jnp.cos(half))
    return rotation.shortest(rotation.multiply(rotation.conjugate(wanted), attitude))


def in_heading_frame(target: Target, vector: Components) -> Components:
    """A vector of the inertial frame in the heading frame: its x axis points where the target looks, z is up.

    At yaw 0 the numbers stay as they are, bit by bit.
    """
    half = jnp.asarray(target.yaw) / 2
    sine, cosine = jnp.sin(half), jnp.cos(half)
    c, s = 1 - 2 * sine * sine, 2 * sine * cosine
    x, y, z = vector
    return c * x + s * y, c * y - s * x, z


def situation(target: Target, state: State, action_change: Float[Array, "4"]) -> Situation:
    """The situation of a true state, after an action that differed from the one before by `action_change`."""
    roll, pitch = rotation.roll_pitch(state.attitude)
    return Situation(
        position_error=position_error(target, state.position),
        attitude_error=attitude_error(target, state.attitude),
        velocity=state.velocity,
        body_rate=state.body_rate,
        altitude=state.position[2],
        roll=roll,
        pitch=pitch,
        action_change=unpack(action_change),
    )
