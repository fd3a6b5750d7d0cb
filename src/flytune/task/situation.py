"""The situation: how far a vehicle is from its target, worked out once and read by rewards and terminations alike."""

from typing import Annotated

import jax.numpy as jnp
from annotated_types import Unit
from jaxtyping import Array, Float

from flytune.document import Real
from flytune.physics import rotation
from flytune.physics.dynamics import State
from flytune.pytree import pytree


@pytree
class Target:
    """Where to hover: a position and a heading, level and at rest (paper R19: (0, 0, 1) m, zero attitude)."""

    position: tuple[Annotated[Real, Unit("m")], Annotated[Real, Unit("m")], Annotated[Real, Unit("m")]]
    yaw: Annotated[Real, Unit("rad")]


@pytree
class Situation:
    """One vehicle, seen from its target."""

    position_error: Float[Array, "3"]  # m, p - p*
    attitude_error: Float[Array, "4"]  # conj(q*) (x) q, real part not negative
    velocity: Float[Array, "3"]  # m/s, inertial frame
    body_rate: Float[Array, "3"]  # rad/s, body frame
    altitude: Float[Array, ""]  # m, z
    roll_pitch: Float[Array, "2"]  # rad
    action_change: Float[Array, "4"]  # a_t - a_{t-1}


def attitude_error(target: Target, attitude: Float[Array, "4"]) -> Float[Array, "4"]:
    """The rotation from the target's attitude to the vehicle's, conj(q*) (x) q, flipped to w >= 0 (reading of R7)."""
    zero = jnp.zeros(())
    wanted = rotation.from_euler(zero, zero, jnp.asarray(target.yaw))
    return rotation.shortest(rotation.multiply(rotation.conjugate(wanted), attitude))


def situation(target: Target, state: State, action_change: Float[Array, "4"]) -> Situation:
    """The situation of a true state, after an action that differed from the one before by `action_change`."""
    return Situation(
        position_error=state.position - jnp.stack(target.position),
        attitude_error=attitude_error(target, state.attitude),
        velocity=state.velocity,
        body_rate=state.body_rate,
        altitude=state.position[2],
        roll_pitch=rotation.roll_pitch_yaw(state.attitude)[:2],
        action_change=action_change,
    )
