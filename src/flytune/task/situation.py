"""The situation: how far a vehicle is from its target, worked out once and read by rewards and terminations alike."""

import math

import jax.numpy as jnp
from jaxtyping import Array, Float

from flytune.config.pytree import pytree
from flytune.physics import rotation
from flytune.physics.components import Components, unpack
from flytune.physics.dynamics import State
from flytune.task.reference import Reference

# m; on x, y, z and on the distance to the target: within it, a response counts as settled. The paper says 2 % and not
# of what; this is 2 % of the target's height of 1 m (C5)
POSITION_BAND = 0.02
YAW_BAND = 0.02 * math.pi  # rad; 2 % of 180 deg


@pytree
class Situation:
    """One vehicle, seen from its target; vectors as tuples of scalars.

    Of a target that rests, the velocity error is the velocity, and the body rate error the body rate.
    """

    position_error: Components  # 3, m, p - p*
    attitude_error: Components  # 4, conj(q*) (x) q, real part not negative
    velocity: Components  # 3, m/s, inertial frame
    velocity_error: Components  # 3, m/s, v - v*, inertial frame
    body_rate: Components  # 3, rad/s, body frame
    body_rate_error: Components  # 3, rad/s, from that of the target, body frame
    altitude: Float[Array, ""]  # m, z
    roll: Float[Array, ""]  # rad
    pitch: Float[Array, ""]  # rad
    action_change: Components  # 4, a_t - a_{t-1}


def position_error(target: Reference, position: Components) -> Components:
    """The way from the target to the vehicle in metres, e_p = p - p* (reading of R7)."""
    return tuple(here - wanted for here, wanted in zip(position, target.position, strict=True))


def attitude_error(target: Reference, attitude: Components) -> Components:
    """The rotation from the target's attitude to the vehicle's, conj(q*) (x) q, flipped to w >= 0 (reading of R7)."""
    if target.motion is not None:
        wanted = target.motion.attitude
    else:
        half = jnp.asarray(target.yaw) / 2
        zero = jnp.zeros(())
        wanted = (zero, zero, jnp.sin(half), jnp.cos(half))
    return rotation.shortest(rotation.multiply(rotation.conjugate(wanted), attitude))


def velocity_error(target: Reference, velocity: Components) -> Components:
    """The velocity relative to that of the target in m/s, v - v*."""
    if target.motion is None:
        return velocity
    return tuple(here - wanted for here, wanted in zip(velocity, target.motion.velocity, strict=True))


def body_rate_error(target: Reference, attitude: Components, body_rate: Components) -> Components:
    """The body rate relative to that of the target in rad/s, w - R(q_e)^T w*, body frame.

    Source: Lee, Leok and McClamroch, "Geometric tracking control of a quadrotor UAV on SE(3)", IEEE CDC 2010, eq. 11.
    """
    if target.motion is None:
        return body_rate
    error = attitude_error(target, attitude)
    wanted = rotation.multiply(rotation.conjugate(error), (*target.motion.body_rate, jnp.zeros(())))
    *seen, _ = rotation.multiply(wanted, error)  # in the frame of the vehicle
    return tuple(here - there for here, there in zip(body_rate, seen, strict=True))


def in_heading_frame(target: Reference, vector: Components) -> Components:
    """A vector of the inertial frame in the heading frame: its x axis points where the target looks, z is up.

    At yaw 0 the numbers stay as they are, bit by bit.
    """
    half = jnp.asarray(target.yaw) / 2
    sine, cosine = jnp.sin(half), jnp.cos(half)
    c, s = 1 - 2 * sine * sine, 2 * sine * cosine
    x, y, z = vector
    return c * x + s * y, c * y - s * x, z


def situation(target: Reference, state: State, action_change: Float[Array, "4"]) -> Situation:
    """The situation of a true state, after an action that differed from the one before by `action_change`."""
    roll, pitch = rotation.roll_pitch(state.attitude)
    return Situation(
        position_error=position_error(target, state.position),
        attitude_error=attitude_error(target, state.attitude),
        velocity=state.velocity,
        velocity_error=velocity_error(target, state.velocity),
        body_rate=state.body_rate,
        body_rate_error=body_rate_error(target, state.attitude, state.body_rate),
        altitude=state.position[2],
        roll=roll,
        pitch=pitch,
        action_change=unpack(action_change),
    )
