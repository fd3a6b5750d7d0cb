"""From thrust and torque back to actions: the inverse of the mixer, of the rotor speed range and of the motors' lag."""

from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from flytune.physics.components import Components, pack
from flytune.physics.dynamics import CONTROL_PERIOD, commanded_rotor_speed, rotor_speed_after
from flytune.physics.vehicle import Vehicle

# the sign of each motor in each torque (paper R4)
ROLL = (-1, -1, 1, 1)
PITCH = (-1, 1, 1, -1)
YAW = (-1, 1, -1, 1)


def hovering_rotors(vehicle: Vehicle) -> Components:
    """Four rotors at hover speed, in rpm: what a controller believes before its first observation."""
    return tuple(jnp.full(4, vehicle.hover_rotor_speed_rpm, float))


def estimated_rotor_speed(vehicle: Vehicle, before: Components, last_action: Components) -> Components:
    """Rotor speeds in rpm now, from those one control period ago and the action since: the motors' own equation.

    Nothing measures rotor speed; the last action, which the observation holds without noise, determines it. An
    action latency is not modelled.
    """
    commanded = tuple(commanded_rotor_speed(vehicle, motor) for motor in last_action)
    return rotor_speed_after(vehicle, before, commanded, CONTROL_PERIOD)


def mixed(vehicle: Vehicle, squares: Components) -> tuple[Any, Components]:
    """Thrust in N and torque in N m of four squared rotor speeds in rpm^2, negative ones included (paper R4)."""
    bending = vehicle.thrust_coefficient * vehicle.lever
    factors = ((ROLL, bending), (PITCH, bending), (YAW, vehicle.torque_coefficient))
    torque = tuple(
        factor * sum((sign * square for sign, square in zip(signs, squares, strict=True)), start=jnp.zeros(()))
        for signs, factor in factors
    )
    return vehicle.thrust_coefficient * sum(squares, start=jnp.zeros(())), torque


def allocate(vehicle: Vehicle, thrust: Any, torque: Components) -> Components:
    """Four rotor speeds in rpm that give a thrust in N and a torque in N m, exactly where the rotors can.

        rpm_i^2 = f / (4 kf) + (ROLL_i tau_x + PITCH_i tau_y) / (4 kf l) + YAW_i tau_z / (4 km)

    the inverse of paper R4. Where a rotor would leave the range of the actions, yaw torque gives way first, then
    thrust, and roll and pitch torque last, in their ratio: tilt decides whether the vehicle stays up, heading does not.

    With r, p, y the three torque terms and m the thrust term, rotors 0 and 2 turn at m - y -+ (r + p), rotors 1 and 3
    at m + y -+ (r - p). So the means of the two pairs, m - y and m + y, each have an interval, once r and p are known.

    Source: the equations, inverted by hand; the order of priorities is the usual one of flight stacks
    (PX4 user guide, "airmode").
    """
    lowest, highest = (commanded_rotor_speed(vehicle, jnp.asarray(action)) ** 2 for action in (-1.0, 1.0))
    bending = 4 * vehicle.thrust_coefficient * vehicle.lever
    roll, pitch = torque[0] / bending, torque[1] / bending
    reach, room = jnp.abs(roll) + jnp.abs(pitch), (highest - lowest) / 2
    share = jnp.where(reach > room, room / jnp.where(reach > room, reach, 1.0), 1.0)
    first, second = share * (roll + pitch), share * (roll - pitch)

    low_a, high_a = lowest + jnp.abs(first), highest - jnp.abs(first)
    low_b, high_b = lowest + jnp.abs(second), highest - jnp.abs(second)
    middle = jnp.clip(thrust / (4 * vehicle.thrust_coefficient), (low_a + low_b) / 2, (high_a + high_b) / 2)
    yaw = jnp.clip(
        torque[2] / (4 * vehicle.torque_coefficient),
        jnp.maximum(low_b - middle, middle - high_a),
        jnp.minimum(high_b - middle, middle - low_a),
    )
    a, b = middle - yaw, middle + yaw
    return tuple(jnp.sqrt(square) for square in (a - first, b - second, a + first, b + second))


def action_for(
    vehicle: Vehicle, now: Components, wanted: Components, motor_time_constant: Any = None
) -> Float[Array, "4"]:
    """The action in [-1, 1]^4 that brings the rotors from the speeds they have to those wanted, all in rpm.

    A motor that lags is asked for more than is wanted, so that it closes the gap as fast as one with the shorter
    time constant `motor_time_constant` would in the control period h:

        command = now + (wanted - now) (1 - exp(-h / motor_time_constant)) / (1 - exp(-h / tau))

    A motor that is faster than that, or answers at once, is asked for what is wanted.

    Args:
        vehicle: whose rotors.
        now: rotor speeds as estimated.
        wanted: rotor speeds.
        motor_time_constant: s; None asks for what is wanted.
    """
    if motor_time_constant is not None:
        hurried = 1 - jnp.exp(-CONTROL_PERIOD / motor_time_constant)
        rising = rotor_speed_after(vehicle, (0.0,), (1.0,), CONTROL_PERIOD)[0]
        falling = 1 - rotor_speed_after(vehicle, (1.0,), (0.0,), CONTROL_PERIOD)[0]
        wanted = tuple(
            speed + (goal - speed) * jnp.maximum(hurried / jnp.where(goal > speed, rising, falling), 1.0)
            for speed, goal in zip(now, wanted, strict=True)
        )
    hover = vehicle.hover_rotor_speed_rpm
    return pack(tuple(jnp.clip((speed / hover - 1) / vehicle.action_scale, -1.0, 1.0) for speed in wanted))
