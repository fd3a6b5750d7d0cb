"""From thrust and torque back to actions: the inverse of the mixer, of the rotor speed range and of the motors' lag."""

from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from flytune.physics.components import Components, add, cross, pack
from flytune.physics.dynamics import angular_momentum, rotor_speed_after
from flytune.physics.rotors import action_of_rotor_speed, commanded_rotor_speed, directions, yaw_coefficient
from flytune.physics.vehicle import Vehicle


def hovering_rotors(vehicle: Vehicle) -> Components:
    """Four rotors at hover speed, in rpm: the estimate before the first observation."""
    return tuple(jnp.full(4, vehicle.hover_rotor_speed_rpm, float))


def estimated_rotor_speed(vehicle: Vehicle, before: Components, last_action: Components) -> Components:
    """Rotor speeds in rpm now, from those one control period ago and the action since: the motors' own equation.

    Nothing measures rotor speed; the last action, which the observation holds without noise, determines it. An
    action latency is not modelled.
    """
    commanded = tuple(commanded_rotor_speed(vehicle, motor) for motor in last_action)
    return rotor_speed_after(vehicle, before, commanded, vehicle.control_period)


def torque_for(vehicle: Vehicle, angular_acceleration: Components, body_rate: Components) -> Components:
    """The torque in N m that gives an angular acceleration in rad/s^2: J a + W x J W (Euler's equation)."""
    turning = angular_momentum(vehicle, angular_acceleration)
    return add(turning, cross(body_rate, angular_momentum(vehicle, body_rate)))


def allocate(vehicle: Vehicle, thrust: Any, torque: Components) -> Components:
    """Four rotor speeds in rpm that give a thrust in N and a torque in N m, exactly where the rotors can.

    Where a rotor would leave the range of the actions, yaw torque is reduced first, then thrust is changed, and roll
    and pitch torque are reduced last, in their ratio: a vehicle falls with a wrong tilt, not with a wrong heading.
    Where thrust or drag torque has a linear part, yaw torque is taken as proportional to thrust, as it is about hover.

    Source: the inverse of paper R4, worked out by hand; the order of priorities is the usual one of flight stacks
    (PX4 user guide, "airmode").
    """
    ends = (commanded_rotor_speed(vehicle, jnp.asarray(action)) for action in (-1.0, 1.0))
    solve = _x_squares if vehicle.rotors is None else _squares
    squares = solve(vehicle, thrust, torque, tuple(map(vehicle.square_of_speed, ends)))
    # at 0, rounding may leave a negative one
    return tuple(vehicle.speed_of_square(jnp.maximum(square, 0.0)) for square in squares)


def _x_squares(vehicle: Vehicle, thrust: Any, torque: Components, limits: Components) -> Components:
    """The squared rotor speeds of the x configuration in rpm^2, see `allocate`.

        rpm_i^2 = f / (4 kf) + (roll_i tau_x + pitch_i tau_y) / (4 kf l) + yaw_i tau_z / (4 km)

    with the signs of paper R4. With r, p, y the three torque terms and m the thrust term, rotors 0 and 2 turn at
    m - y -+ (r + p), rotors 1 and 3 at m + y -+ (r - p). So the means of the two pairs, m - y and m + y, each have an
    interval, once r and p are known.
    """
    lowest, highest = limits
    bending = 4 * vehicle.thrust_coefficient * vehicle.lever
    roll, pitch = torque[0] / bending, torque[1] / bending
    reach, room = jnp.abs(roll) + jnp.abs(pitch), (highest - lowest) / 2
    share = jnp.where(reach > room, room / jnp.where(reach > room, reach, 1.0), 1.0)
    first, second = share * (roll + pitch), share * (roll - pitch)

    low_a, high_a = lowest + jnp.abs(first), highest - jnp.abs(first)
    low_b, high_b = lowest + jnp.abs(second), highest - jnp.abs(second)
    middle = jnp.clip(thrust / (4 * vehicle.thrust_coefficient), (low_a + low_b) / 2, (high_a + high_b) / 2)
    yaw = jnp.clip(
        torque[2] / (4 * yaw_coefficient(vehicle)),
        jnp.maximum(low_b - middle, middle - high_a),
        jnp.minimum(high_b - middle, middle - low_a),
    )
    a, b = middle - yaw, middle + yaw
    return a - first, b - second, a + first, b + second


def _squares(vehicle: Vehicle, thrust: Any, torque: Components, limits: Components) -> Components:
    """The squared rotor speeds of any layout in rpm^2, see `allocate`.

    The squares are q_i = s r_i + t_i f + c_i y: roll and pitch torque give r, of which the share s is kept, and t and c
    are the shares of thrust and yaw torque of each rotor. All q_i have to lie within the limits. These conditions bound
    y once s and f are known; that such a y exists bounds f once s is known; and that such an f exists bounds s
    (Fourier-Motzkin elimination). So s, f and y are found in this order, each as near as possible to its wanted value.
    """
    square = vehicle.hover_square  # everything is in units in which hovering takes 1
    weight = vehicle.mass * vehicle.gravity
    rows = jnp.asarray([(1, 1, 1, 1), *directions(vehicle)], float)
    reach = jnp.max(jnp.abs(rows[1:3]))
    columns = jnp.linalg.inv(rows / jnp.stack([1.0, reach, reach, 1.0])[:, None] / 4)
    units = (weight, weight * reach, weight * reach, weight * yaw_coefficient(vehicle) / vehicle.thrust_coefficient)
    wanted_thrust, roll, pitch, wanted_yaw = (part / unit for part, unit in zip((thrust, *torque), units, strict=True))
    r = columns[:, 1] * roll + columns[:, 2] * pitch
    t, c = columns[:, 0], columns[:, 3]
    low, high = (limit / square for limit in limits)
    # y <= upper_i - a_i s - b_i f and y >= lower_i - a_i s - b_i f, for each rotor i
    a, b = r / c, t / c
    upper, lower = jnp.where(c > 0, high, low) / c, jnp.where(c > 0, low, high) / c
    # some y exists: g_k f <= h_k - e_k s, for each pair of rotors k
    e, g = (jnp.ravel(part[:, None] - part[None]) for part in (a, b))
    h = jnp.ravel(upper[:, None] - lower[None])
    rises, falls = g > 0, g < 0
    size = jnp.where(rises | falls, jnp.abs(g), 1.0)
    e, h = e / size, h / size
    # some f exists: the largest share s of roll and pitch torque, at most 1
    pair = rises[:, None] & falls[None]
    steep, room = e[:, None] + e[None], h[:, None] + h[None]
    steep = jnp.concatenate([jnp.ravel(jnp.where(pair, steep, 0.0)), jnp.where(rises | falls, 0.0, e)])
    room = jnp.concatenate([jnp.ravel(room), h])
    share = jnp.min(jnp.where(steep > 0, room / jnp.where(steep > 0, steep, 1.0), 1.0), initial=1.0)
    left = h - e * share
    force = jnp.clip(
        wanted_thrust, jnp.max(jnp.where(falls, -left, -jnp.inf)), jnp.min(jnp.where(rises, left, jnp.inf))
    )
    known = a * share + b * force
    yaw = jnp.clip(wanted_yaw, jnp.max(lower - known), jnp.min(upper - known))
    return tuple(jnp.clip(share * r + force * t + yaw * c, low, high) * square)


def action_for(
    vehicle: Vehicle, now: Components, wanted: Components, motor_time_constant: Any = None
) -> Float[Array, "4"]:
    """The action in [-1, 1]^4 that brings the rotors from the speeds they have to those wanted, all in rpm.

    The command of a motor that lags goes beyond the wanted speed, so that the motor closes the gap as fast as one with
    the shorter time constant `motor_time_constant` in s would in the control period h:

        command = now + (wanted - now) (1 - exp(-h / motor_time_constant)) / (1 - exp(-h / tau))

    A motor that is faster than that gets the wanted speed as its command; without the constant, each motor does.

    Args:
        vehicle: its motors and its convention of actions.
        now: rotor speeds in rpm.
        wanted: likewise.
        motor_time_constant: in s, or None.
    """
    if motor_time_constant is not None:
        period = vehicle.control_period
        faster = 1 - jnp.exp(-period / motor_time_constant)
        rising = rotor_speed_after(vehicle, (0.0,), (1.0,), period)[0]
        falling = 1 - rotor_speed_after(vehicle, (1.0,), (0.0,), period)[0]
        wanted = tuple(
            speed + (goal - speed) * jnp.maximum(faster / jnp.where(goal > speed, rising, falling), 1.0)
            for speed, goal in zip(now, wanted, strict=True)
        )
    return pack(tuple(jnp.clip(action_of_rotor_speed(vehicle, speed), -1.0, 1.0) for speed in wanted))
