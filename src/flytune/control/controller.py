"""The protocol of every controller, and the parts that the classical controllers share: fields and an outer loop."""

from typing import Any, Protocol, runtime_checkable

import jax.numpy as jnp
from jaxtyping import Array, Float

from flytune.config.pytree import pytree
from flytune.control.actuation import hovering_rotors
from flytune.physics.components import Components, scale
from flytune.physics.rotation import safe_norm
from flytune.physics.vehicle import Vehicle


@runtime_checkable
class Controller(Protocol):
    """A controller: a JAX pytree that turns observations into actions, with a memory from one to the next."""

    def initial_memory(self) -> Any:
        """The memory before the first observation, a pytree; () for a controller without memory."""
        ...

    def act(self, memory: Any, observation: Float[Array, "17"]) -> tuple[Any, Float[Array, "4"]]:
        """The memory after, and the action in [-1, 1]^4, of one noisy observation (paper R7, R9)."""
        ...


@pytree
class ClassicalController:
    """A control law for one vehicle; it remembers its estimate of the rotor speeds."""

    vehicle: Vehicle
    speed_limit: Any  # m/s, or None
    tilt_limit: Any  # rad
    body_rate_limit: Any  # rad/s, or None

    def initial_memory(self) -> Any:
        """Rotors at hover speed, in rpm."""
        return hovering_rotors(self.vehicle)


def shortened(vector: Components, longest: Any) -> Components:
    """The vector, cut to the length `longest` where it is longer; None does not cut."""
    if longest is None:
        return vector
    length = safe_norm(vector)
    return scale(jnp.where(length > longest, longest / jnp.where(length > longest, length, 1.0), 1.0), vector)


def slowed(position_error: Components, pull: Components, speed_limit: Any) -> Components:
    """The position error in m, cut so that a linear law does not fly faster than the limit in m/s; None does not cut.

    A law a = -k_p e - k_v v cruises where both cancel, at v = -(k_p / k_v) e. With the pull k_p / k_v of each axis
    in 1/s, the error is scaled down until the length of that velocity is the limit. Its direction stays.
    """
    if speed_limit is None:
        return position_error
    speed = safe_norm(tuple(k * e for k, e in zip(pull, position_error, strict=True)))
    too_fast = speed > speed_limit
    return scale(jnp.where(too_fast, speed_limit / jnp.where(too_fast, speed, 1.0), 1.0), position_error)


def specific_force(vehicle: Vehicle, acceleration: Components, largest_tilt: Any) -> Components:
    """Thrust over mass in m/s^2, inertial frame, that gives an acceleration with at most a tilt in rad, below pi/2.

    The vertical part is kept above half the weight, so that thrust has a direction; then the horizontal part is cut.
    """
    up = jnp.maximum(vehicle.gravity + acceleration[2], 0.5 * vehicle.gravity)
    return *shortened(acceleration[:2], up * jnp.tan(largest_tilt)), up
