"""The outer loop that classical controllers share: how a position error is kept from asking for too much."""

import math
from typing import Any

import jax.numpy as jnp

from flytune.physics.components import Components, scale
from flytune.physics.rotation import safe_norm
from flytune.physics.vehicle import Vehicle


def shortened(vector: Components, longest: Any) -> Components:
    """The vector, cut to the length `longest` where it is longer; None does not cut."""
    if longest is None:
        return vector
    length = safe_norm(vector)
    return scale(jnp.where(length > longest, longest / jnp.where(length > longest, length, 1.0), 1.0), vector)


def slowed(position_error: Components, pull: Components, speed_limit: Any) -> Components:
    """The position error in m, cut so that a linear law does not fly faster than the limit.

    A law a = -k_p e - k_v v cruises where both cancel, at v = -(k_p / k_v) e. With the pull k_p / k_v of each axis
    in 1/s, the error is scaled down until the length of that velocity is the limit. Its direction stays.

    Args:
        position_error: p - p* in m.
        pull: k_p / k_v of each axis, in 1/s.
        speed_limit: m/s; None does not cut.
    """
    if speed_limit is None:
        return position_error
    speed = safe_norm(tuple(k * e for k, e in zip(pull, position_error, strict=True)))
    too_fast = speed > speed_limit
    return scale(jnp.where(too_fast, speed_limit / jnp.where(too_fast, speed, 1.0), 1.0), position_error)


def specific_force(vehicle: Vehicle, acceleration: Components, largest_tilt: Any) -> Components:
    """Thrust over mass in m/s^2, inertial frame, that gives an acceleration without tilting further than allowed.

    The vertical part is kept above half the weight, so that thrust has a direction; then the horizontal part is cut.

    Args:
        vehicle: whose gravity counts.
        acceleration: wanted, in m/s^2.
        largest_tilt: rad, below pi/2.
    """
    up = jnp.maximum(vehicle.gravity + acceleration[2], 0.5 * vehicle.gravity)
    return *shortened(acceleration[:2], up * jnp.tan(largest_tilt)), up


def tighter(limit: float, bound: float | None) -> float:
    """The smaller of a limit and a bound; the limit where there is no bound."""
    return min(limit, math.inf if bound is None else bound)
