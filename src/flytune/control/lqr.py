"""A linear quadratic regulator: the vehicle linearised about hover, and the best linear feedback for it."""

import dataclasses
from typing import Annotated, Any

import jax
import jax.numpy as jnp
import numpy as np
from annotated_types import Gt, Le, Unit
from jaxtyping import Array, Float

from flytune.config.document import Real
from flytune.config.pytree import pytree
from flytune.control.actuation import action_for, allocate, estimated_rotor_speed
from flytune.control.controller import ClassicalController, shortened, slowed
from flytune.control.sensing import Sensed, heading, sense
from flytune.errors import BadInput
from flytune.physics import dynamics, rotation
from flytune.physics.components import Components, pack, unpack
from flytune.physics.rotors import (
    directions,
    hover_action,
    mixed,
    rotor_speed_per_action,
    square_per_rotor_speed,
)
from flytune.physics.vehicle import Vehicle

# The state: position error (3) in m and velocity (3) in m/s, in axes that turn with the heading; roll, pitch and yaw
# error in rad; body rate (3) in rad/s; rotor speed (4) in units of the action.
STATES = 16
Metres = Annotated[Real, Gt(0), Unit("m")]
Speed = Annotated[Real, Gt(0), Unit("m/s")]
Radians = Annotated[Real, Gt(0), Unit("rad")]
Rate = Annotated[Real, Gt(0), Unit("rad/s")]


@pytree
class LqrGains:
    """The largest deviations that are acceptable: each weight is the inverse of its square (Bryson's rule)."""

    horizontal_error: Metres
    vertical_error: Metres
    horizontal_speed: Speed
    vertical_speed: Speed
    tilt: Radians
    yaw_error: Radians
    tilt_rate: Rate
    yaw_rate: Rate
    action: Annotated[Real, Gt(0), Unit("1")]
    largest_yaw_error: Radians  # fed to the law; a larger one is cut to it
    largest_tilt: Annotated[Real, Gt(0), Le(1), Unit("rad")]
    bound_share: Annotated[Real, Gt(0), Le(1), Unit("1")]  # of the task's bounds on speed, tilt and rate that is used


@pytree
class Lqr(ClassicalController):
    """The feedback u = -K x."""

    gain: Float[Array, "4 16"]  # K: action per unit of each state
    gains: LqrGains

    def act(self, memory: Components, observation: Float[Array, "17"]) -> tuple[Components, Float[Array, "4"]]:
        """The action of one observation, see `Controller`.

        The linear law gives small changes of thrust, f_i = f_hover + (df/da at hover) u_i. The allocation turns their
        sums into rotor speeds, because it also decides what is reduced where a rotor is at its limit.
        """
        sensed = sense(observation)
        rotors = estimated_rotor_speed(self.vehicle, memory, sensed.last_action)
        change = unpack(-self.gain @ pack(self.deviation(sensed, rotors)))
        slope = square_per_rotor_speed(self.vehicle) * rotor_speed_per_action(self.vehicle)
        squares = tuple(self.vehicle.hover_square + slope * u for u in change)
        thrust, torque = mixed(self.vehicle, squares)
        return rotors, action_for(self.vehicle, rotors, allocate(self.vehicle, thrust, torque))

    def deviation(self, sensed: Sensed, rotors: Components) -> Components:
        """The state that is fed back, with position and yaw errors cut to what the limits allow."""
        yaw = heading(sensed.attitude)
        tilted = rotation.multiply(rotation.from_euler(jnp.zeros(()), jnp.zeros(()), -yaw), sensed.attitude)
        position = self.reachable(_turned(sensed.position_error, yaw))
        largest = self.gains.largest_yaw_error
        if self.body_rate_limit is not None:
            largest = jnp.minimum(largest, self.body_rate_limit / self._ratio(directions(self.vehicle)[2], 8, 11))
        yaw_error = jnp.clip(yaw, -largest, largest)
        speeds = _in_actions(self.vehicle, rotors)
        velocity = _turned(sensed.velocity, yaw)
        return *position, *velocity, 2 * tilted[0], 2 * tilted[1], yaw_error, *sensed.body_rate, *speeds

    def reachable(self, position_error: Components) -> Components:
        """The position error in m, cut until neither the speed nor the tilt that it causes exceeds its limit."""
        pitch = directions(self.vehicle)[1]
        horizontal, vertical = self._ratio(pitch, 0, 3), self._ratio((1, 1, 1, 1), 2, 5)
        tilt_per_metre = jnp.abs(self._ratio(pitch, 0, 7))
        error = slowed(position_error, (horizontal, horizontal, vertical), self.speed_limit)
        return *shortened(error[:2], self.tilt_limit / tilt_per_metre), error[2]

    def _ratio(self, motors: Components, state: int, to: int) -> Any:
        """The ratio of the gains of two states, in this combination of the motors."""
        row = jnp.asarray(motors, float) @ self.gain
        return row[state] / row[to]


def feedback(vehicle: Vehicle, gains: LqrGains) -> Float[np.ndarray, "4 16"]:
    """The gain K that minimises sum(x' Q x + u' R u) for x_{k+1} = A x_k + B u_k at the control period.

        P = A' P A - A' P B (R + B' P B)^-1 B' P A + Q;    K = (R + B' P B)^-1 B' P A

    Raises:
        BadInput: the Riccati equation has no stabilising solution in floating point.
    """
    a, b = linearised(vehicle)
    q, r = weights(gains)
    try:
        from scipy.linalg import solve_discrete_are  # late, because it is slow to import

        p = solve_discrete_are(a, b, q, r)
    except np.linalg.LinAlgError as error:
        raise BadInput(f"lqr: no feedback for these weights ({error}). Bring them nearer to the textbook's.") from None
    return np.linalg.solve(r + b.T @ p @ b, b.T @ p @ a)


def weights(gains: LqrGains) -> tuple[np.ndarray, np.ndarray]:
    """Q [16, 16] and R [4, 4]: one over the square of each largest acceptable deviation; rotor speeds cost nothing.

    Source: Bryson and Ho, "Applied Optimal Control", 1975, section 5.2.
    """
    g = gains
    largest = [g.horizontal_error] * 2 + [g.vertical_error] + [g.horizontal_speed] * 2 + [g.vertical_speed]
    largest += [g.tilt] * 2 + [g.yaw_error] + [g.tilt_rate] * 2 + [g.yaw_rate]
    return np.diag([float(v) ** -2 for v in largest] + [0.0] * 4), np.eye(4) * float(g.action) ** -2


def linearised(vehicle: Vehicle) -> tuple[np.ndarray, np.ndarray]:
    """A [16, 16] and B [16, 4] of one control period about hover: the derivative of the simulated step.

    The motors' lag and the drag are in it. An action latency is not.
    """
    a, b = _jacobians(vehicle, jnp.zeros(STATES), jnp.zeros(4))
    return np.asarray(a, np.float64), np.asarray(b, np.float64)


def _after(vehicle: Vehicle, x: Float[Array, "16"], u: Float[Array, "4"]) -> Float[Array, "16"]:
    """The deviation from hover one control period later."""
    parts, hover = unpack(x), vehicle.hover_rotor_speed_rpm
    latest = dataclasses.replace(vehicle, action_latency_steps=0)
    state = dynamics.State(
        position=parts[:3],
        velocity=parts[3:6],
        attitude=rotation.exponential(parts[6:9]),
        body_rate=parts[9:12],
        rotor_speed_rpm=tuple(hover + rotor_speed_per_action(vehicle) * r for r in parts[12:]),
        pending_actions=dynamics.no_pending_actions(latest),
    )
    end = dynamics.step(latest, state, hover_action(vehicle) + u)
    speeds = _in_actions(vehicle, end.rotor_speed_rpm)
    angles = tuple(2 * part for part in end.attitude[:3])
    return pack((*end.position, *end.velocity, *angles, *end.body_rate, *speeds))


def _in_actions(vehicle: Vehicle, rotors: Components) -> Components:
    """How far rotor speeds lie from hover, in units of the action."""
    hover, slope = vehicle.hover_rotor_speed_rpm, rotor_speed_per_action(vehicle)
    return tuple((speed - hover) / slope for speed in rotors)


_jacobians = jax.jit(jax.jacrev(_after, argnums=(1, 2)))


def _turned(vector: Components, yaw: Any) -> Components:
    """A vector of the heading frame in axes turned further, by the vehicle's yaw."""
    x, y, z = vector
    c, s = jnp.cos(yaw), jnp.sin(yaw)
    return c * x + s * y, c * y - s * x, z
