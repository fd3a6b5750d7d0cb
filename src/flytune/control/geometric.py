"""Geometric tracking control on SE(3): attitude errors as rotation matrices, without angles that wrap.

Source: Lee, Leok and McClamroch, "Geometric tracking control of a quadrotor UAV on SE(3)", IEEE CDC 2010, for a target
that stands still. Their z axis points down; here it points up, which turns the sign of gravity and thrust.
"""

from typing import Annotated, Any

import jax
import jax.numpy as jnp
from annotated_types import Gt, Le, Lt, Unit
from jaxtyping import Array, Float

from flytune.config.document import Real
from flytune.config.pytree import pytree
from flytune.control.actuation import action_for, allocate, estimated_rotor_speed, torque_for
from flytune.control.controller import ClassicalController, slowed, specific_force
from flytune.control.sensing import Sensed, body_axes, dot, heading, sense
from flytune.physics.components import Components, add, cross, scale
from flytune.physics.rotation import safe_norm
from flytune.physics.rotors import thrust_and_torque

Axes = tuple[Components, Components, Components]  # the columns of a rotation matrix


@pytree
class GeometricGains:
    """The paper's four gains, per unit of mass and of inertia, and limits."""

    position: Annotated[Real, Gt(0), Unit("1/s^2")]  # k_x / m
    velocity: Annotated[Real, Gt(0), Unit("1/s")]  # k_v / m
    attitude: Annotated[Real, Gt(0), Unit("1/s^2")]  # k_R / J
    body_rate: Annotated[Real, Gt(0), Unit("1/s")]  # k_Omega / J
    largest_yaw_error: Annotated[Real, Gt(0), Lt(1.57), Unit("rad")]  # fed to the law; a larger one is cut to it
    largest_tilt: Annotated[Real, Gt(0), Le(1), Unit("rad")]
    bound_share: Annotated[Real, Gt(0), Le(1), Unit("1")]  # of the task's bounds on speed, tilt and rate that is used
    motor_time_constant: Annotated[Real, Gt(0), Unit("s")]  # slower motors are driven as if they had this one


@pytree
class Geometric(ClassicalController):
    """The law of the paper."""

    gains: GeometricGains

    def act(self, memory: Components, observation: Float[Array, "17"]) -> tuple[Components, Float[Array, "4"]]:
        """The action of one observation, see `Controller`.

            f = F . R e3                                                 (eq. 15; F: the force of eq. 12, without minus)
            M = J (-k_R e_R - k_W e_W) + W x J W - J (W x R^T R_d W_d)   (eq. 16)

        The derivative of W_d is left out: it needs the jerk, which is not measured.
        """
        sensed = sense(observation)
        rotors = estimated_rotor_speed(self.vehicle, memory, sensed.last_action)
        axes = body_axes(sensed.attitude)
        thrust_now, _ = thrust_and_torque(self.vehicle, rotors)
        fall = (0.0, 0.0, -self.vehicle.gravity)
        acceleration_now = add(scale(thrust_now / self.vehicle.mass, axes[2]), fall)
        yaw = self.reference_yaw(sensed)

        def wanted_axes(position_error: Components, velocity: Components) -> Axes:
            return wanted_attitude(self.force(position_error, velocity), yaw)

        wanted, turning = jax.jvp(
            wanted_axes, (sensed.position_error, sensed.velocity), (sensed.velocity, acceleration_now)
        )
        reference = turned_by(axes, turn_of(wanted, turning), wanted)
        rate_error = tuple(w - r for w, r in zip(sensed.body_rate, reference, strict=True))
        turn = add(
            scale(-self.gains.attitude, attitude_error_vector(axes, wanted)),
            scale(-self.gains.body_rate, rate_error),
            scale(-1, cross(sensed.body_rate, reference)),
        )
        thrust = self.vehicle.mass * dot(self.force(sensed.position_error, sensed.velocity), axes[2])
        speeds = allocate(self.vehicle, thrust, torque_for(self.vehicle, turn, sensed.body_rate))
        return rotors, action_for(self.vehicle, rotors, speeds, self.gains.motor_time_constant)

    def force(self, position_error: Components, velocity: Components) -> Components:
        """Thrust over mass that is wanted, in m/s^2, inertial frame: g e3 - k_x e_x - k_v e_v (eq. 12).

        The position error is cut to what the speed limit allows, and the tilt to its own limit.
        """
        g = self.gains
        pull = (g.position / g.velocity,) * 3
        error = slowed(position_error, pull, self.speed_limit)
        return specific_force(
            self.vehicle, add(scale(-g.position, error), scale(-g.velocity, velocity)), self.tilt_limit
        )

    def reference_yaw(self, sensed: Sensed) -> Any:
        """The heading to steer for in rad: the target's, or the nearest that is not too far from the present one.

        At half a turn e_R vanishes, in tilt as well as in yaw, and the law would not move: a far target is approached
        by way of nearer ones. The vehicle turns at (k_R / k_W) sin(yaw error), which the rate limit bounds further.
        """
        g = self.gains
        largest = g.largest_yaw_error
        if self.body_rate_limit is not None:
            sine = jnp.minimum(g.body_rate * self.body_rate_limit / g.attitude, 1.0)
            largest = jnp.minimum(largest, jnp.arcsin(sine))
        yaw = heading(sensed.attitude)
        return yaw - jnp.clip(yaw, -largest, largest)


def wanted_attitude(force: Components, yaw: Any) -> Axes:
    """R_d = [b1 b2 b3]: b3 along the force, b1 as near to the heading as that leaves it (Lee et al., eq. 12 and 13)."""
    up = scale(1 / safe_norm(force), force)
    left = cross(up, (jnp.cos(yaw), jnp.sin(yaw), jnp.zeros(())))
    left = scale(1 / safe_norm(left), left)
    return cross(left, up), left, up


def attitude_error_vector(axes: Axes, wanted: Axes) -> Components:
    """e_R = 1/2 (R_d^T R - R^T R_d)^vee, of size sin(angle) (Lee et al., eq. 10)."""
    r1, r2, r3 = axes
    d1, d2, d3 = wanted
    return (
        (dot(d3, r2) - dot(d2, r3)) / 2,
        (dot(d1, r3) - dot(d3, r1)) / 2,
        (dot(d2, r1) - dot(d1, r2)) / 2,
    )


def turn_of(wanted: Axes, turning: Axes) -> Components:
    """W_d = (R_d^T dR_d/dt)^vee in rad/s, in the wanted frame."""
    (d1, d2, d3), (t1, t2, t3) = wanted, turning
    return dot(d3, t2), dot(d1, t3), dot(d2, t1)


def turned_by(axes: Axes, turn: Components, wanted: Axes) -> Components:
    """R^T R_d W_d: the wanted turn seen in the body frame (the second half of e_W, Lee et al., eq. 11)."""
    inertial = add(*(scale(rate, axis) for rate, axis in zip(turn, wanted, strict=True)))
    return tuple(dot(axis, inertial) for axis in axes)
