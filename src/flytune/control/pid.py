"""A cascaded PID: position, velocity, attitude, body rate, mixer; each loop gives the next one its reference."""

from typing import Annotated

import jax.numpy as jnp
from annotated_types import Ge, Gt, Le, Unit
from jaxtyping import Array, Float

from flytune.config.document import Real
from flytune.config.pytree import pytree
from flytune.control.actuation import action_for, allocate, estimated_rotor_speed, torque_for
from flytune.control.controller import ClassicalController, shortened, slowed, specific_force
from flytune.control.sensing import Sensed, body_axes, dot, heading, sense
from flytune.physics.components import Components, add, scale
from flytune.physics.rotation import safe_norm

PerSecond = Annotated[Real, Gt(0), Unit("1/s")]


@pytree
class PidGains:
    """Gains per unit of mass and of inertia, so that they carry over from vehicle to vehicle."""

    horizontal_position: PerSecond
    vertical_position: PerSecond
    horizontal_velocity: PerSecond
    vertical_velocity: PerSecond
    position_integral: Annotated[Real, Ge(0), Unit("1/s^3")]
    integral_zone: Annotated[Real, Ge(0), Unit("m")]  # the integral grows only this near to the target
    integral_limit: Annotated[Real, Ge(0), Unit("m/s^2")]  # of the acceleration from the integral
    tilt: PerSecond
    yaw: PerSecond
    tilt_rate: PerSecond
    yaw_rate: PerSecond
    largest_yaw_rate: Annotated[Real, Gt(0), Unit("rad/s")]
    largest_tilt: Annotated[Real, Gt(0), Le(1), Unit("rad")]
    bound_share: Annotated[Real, Gt(0), Le(1), Unit("1")]  # of the task's bounds on speed, tilt and rate that is used
    motor_time_constant: Annotated[Real, Gt(0), Unit("s")]  # slower motors are driven as if they had this one


@pytree
class PidMemory:
    """What the PID remembers."""

    integral: Components  # 3, m s, of the position error
    rotor_speed_rpm: Components  # 4, as estimated


@pytree
class Pid(ClassicalController):
    """The cascade."""

    gains: PidGains

    def initial_memory(self) -> PidMemory:
        """Nothing summed up, rotors at hover speed."""
        return PidMemory(integral=tuple(jnp.zeros(3)), rotor_speed_rpm=super().initial_memory())

    def act(self, memory: PidMemory, observation: Float[Array, "17"]) -> tuple[PidMemory, Float[Array, "4"]]:
        """The action of one observation, see `Controller`."""
        sensed = sense(observation)
        rotors = estimated_rotor_speed(self.vehicle, memory.rotor_speed_rpm, sensed.last_action)
        acceleration, integral = self.acceleration(sensed, memory.integral)
        force = specific_force(self.vehicle, acceleration, self.tilt_limit)
        turn = self.angular_acceleration(sensed, force)
        thrust = self.vehicle.mass * dot(force, body_axes(sensed.attitude)[2])
        wanted = allocate(self.vehicle, thrust, torque_for(self.vehicle, turn, sensed.body_rate))
        action = action_for(self.vehicle, rotors, wanted, self.gains.motor_time_constant)
        return PidMemory(integral=integral, rotor_speed_rpm=rotors), action

    def acceleration(self, sensed: Sensed, integral: Components) -> tuple[Components, Components]:
        """The acceleration wanted in m/s^2, and the integral of the position error after this step in m s.

            v_ref = -k_p e_p, no longer than the speed limit;    a = k_v (v_ref - v) - k_i integral(e_p)

        Anti-windup: the integral grows only within the integral zone, and what it adds is bounded.
        """
        g = self.gains
        pull = (g.horizontal_position, g.horizontal_position, g.vertical_position)
        damping = (g.horizontal_velocity, g.horizontal_velocity, g.vertical_velocity)
        error = slowed(sensed.position_error, pull, self.speed_limit)
        near = safe_norm(sensed.position_error) <= g.integral_zone
        grown = add(integral, scale(jnp.where(near, self.vehicle.control_period, 0.0), sensed.position_error))
        added = shortened(scale(-g.position_integral, grown), g.integral_limit)
        kept = safe_norm(scale(g.position_integral, grown)) <= g.integral_limit
        integral = tuple(jnp.where(kept, new, old) for new, old in zip(grown, integral, strict=True))
        terms = zip(damping, pull, error, sensed.velocity, strict=True)
        return add(tuple(k_v * (-k_p * e - v) for k_v, k_p, e, v in terms), added), integral

    def angular_acceleration(self, sensed: Sensed, force: Components) -> Components:
        """The angular acceleration wanted in rad/s^2, body frame: w_ref = k (angle to turn), then k (w_ref - w).

        Tilt and heading are steered apart: the tilt error is the rotation that takes the body's z axis to the
        direction of the wanted force, whatever the heading, so that a large yaw error does not spoil it.

        Source: the split, Brescianini and D'Andrea, "Tilt-prioritized quadrocopter attitude control", IEEE TCST 2020.
        """
        g = self.gains
        forward, left, up = body_axes(sensed.attitude)
        x, y, z = (dot(force, axis) for axis in (forward, left, up))
        sine = safe_norm((x, y))
        angle = jnp.arctan2(sine, z)
        ratio = jnp.where(sine > 0, angle / jnp.where(sine > 0, sine, 1.0), 0.0)
        tilt_rate = shortened((-g.tilt * ratio * y, g.tilt * ratio * x), self.body_rate_limit)
        yaw_error = heading(sensed.attitude)
        fastest = g.largest_yaw_rate
        if self.body_rate_limit is not None:  # the rest of it beside tilting
            left_over = jnp.sqrt(jnp.maximum(self.body_rate_limit**2 - safe_norm(tilt_rate) ** 2, 0.0))
            fastest = jnp.minimum(fastest, left_over)
        yaw_rate = jnp.clip(-g.yaw * yaw_error, -fastest, fastest)
        speed_up = (g.tilt_rate, g.tilt_rate, g.yaw_rate)
        wanted = zip(speed_up, (*tilt_rate, yaw_rate), sensed.body_rate, strict=True)
        return tuple(k * (reference - w) for k, reference, w in wanted)
