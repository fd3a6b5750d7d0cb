"""The four rotors: their places and spins, their thrust and torque, and what an action asks of them.

Everything that depends on the layout of the rotors takes it from here: the equations of motion, the allocation of
thrust and torque to rotors, the simulators' files, the ground effect and the picture.
"""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from flytune.physics.components import Components
from flytune.physics.vehicle import TrueVehicle, Vehicle

# the x configuration (paper R4): side of each rotor on the x and y axes, and the sign of its torque about z
X_SIDES = ((1, -1), (-1, -1), (-1, 1), (1, 1))
X_SPINS = (-1, 1, -1, 1)


def spins(vehicle: Vehicle) -> tuple[int, ...]:
    """The sign of each rotor's torque about z."""
    return X_SPINS if vehicle.rotors is None else vehicle.rotors.spin


def directions(vehicle: Vehicle) -> tuple[Components, Components, Components]:
    """What each rotor's thrust adds to roll and pitch torque, and its drag to yaw torque, one row each.

    The first two rows hold y and -x of the rotors, in metres; in the x configuration they are signs, to be multiplied
    with the vehicle's `lever`. The third row holds the spins.
    """
    sides = X_SIDES if vehicle.rotors is None else vehicle.rotors.place
    return tuple(y for _, y in sides), tuple(-x for x, _ in sides), spins(vehicle)


def places(vehicle: Vehicle) -> Float[np.ndarray, "4 2"]:
    """Where the rotors stand in the body frame, x and y in m, of a vehicle with plain numbers."""
    if vehicle.rotors is not None:
        return np.array(vehicle.rotors.place, float)
    return np.array(X_SIDES) * float(vehicle.lever)


def reach(vehicle: Vehicle) -> float:
    """Distance of the farthest rotor from the centre in m, of a vehicle with plain numbers."""
    return float(vehicle.arm) if vehicle.arm is not None else float(np.linalg.norm(places(vehicle), axis=1).max())


def thrust(vehicle: Vehicle, rotor_speed_rpm: Any) -> Any:
    """Thrust of a rotor in N at a speed in rpm: kf rpm^2 (paper R4), and a linear part where the vehicle has one."""
    return vehicle.thrust_coefficient * vehicle.square_of_speed(rotor_speed_rpm)


def drag_torque(vehicle: Vehicle, rotor_speed_rpm: Any) -> Any:
    """Drag torque of a rotor in N m at a speed in rpm: km rpm^2 (paper R4), and a linear part likewise."""
    torque = vehicle.torque_coefficient * (rotor_speed_rpm * rotor_speed_rpm)
    return torque if vehicle.torque_linear is None else torque + vehicle.torque_linear * rotor_speed_rpm


def yaw_coefficient(vehicle: Vehicle) -> Any:
    """Drag torque per square of `Vehicle.square_of_speed` in N m/rpm^2 about hover.

    It is the torque coefficient where neither curve has a linear part.
    """
    if vehicle.thrust_linear is None and vehicle.torque_linear is None:
        return vehicle.torque_coefficient
    torque = 2 * vehicle.torque_coefficient * vehicle.hover_rotor_speed_rpm + _given(vehicle.torque_linear)
    return torque / square_per_rotor_speed(vehicle)


def mixed(vehicle: Vehicle, squares: Components, yaw_torque: Any = None) -> tuple[Any, Components]:
    """Thrust along the body's z axis in N, and torque in the body frame in N m, of squared rotor speeds in rpm^2.

        f_i = kf rpm_i^2
        tau_x = sum y_i f_i,   tau_y = -sum x_i f_i,   tau_z = km sum spin_i rpm_i^2

    With a linear part of the thrust, the squares are those of `Vehicle.square_of_speed`; `yaw_torque` is then tau_z,
    which without it follows from the `yaw_coefficient`. Negative squares are taken too, as a linear law may ask for
    them.

    Source: paper R4, where x and y of the rotors are l = arm / sqrt(2) in size.
    """
    roll, pitch, yaw = directions(vehicle)
    if vehicle.rotors is None:
        bending = vehicle.thrust_coefficient * vehicle.lever
        torque = (bending * signed_sum(roll, squares), bending * signed_sum(pitch, squares))
    else:
        torque = tuple(
            vehicle.thrust_coefficient * sum(arm * square for arm, square in zip(arms, squares, strict=True))
            for arms in (roll, pitch)
        )
    if yaw_torque is None:
        yaw_torque = yaw_coefficient(vehicle) * signed_sum(yaw, squares)
    return vehicle.thrust_coefficient * signed_sum((1, 1, 1, 1), squares), (*torque, yaw_torque)


def thrust_and_torque(vehicle: Vehicle, rotor_speed_rpm: Components) -> tuple[Any, Components]:
    """Thrust in N and torque in N m of rotor speeds in rpm, see `mixed`."""
    squares = tuple(vehicle.square_of_speed(speed) for speed in rotor_speed_rpm)
    if vehicle.thrust_linear is None and vehicle.torque_linear is None:
        return mixed(vehicle, squares)
    torques = tuple(drag_torque(vehicle, speed) for speed in rotor_speed_rpm)
    return mixed(vehicle, squares, signed_sum(spins(vehicle), torques))


def commanded_rotor_speed(vehicle: Vehicle, action: Any, numpy: Any = jnp) -> Any:
    """The rotor speed in rpm that an action of one motor asks for, within the motor's limits.

        hover_relative   rpm = hover speed * (1 + action_scale * action)   (paper R9, where action_scale is 1/2)
        rotor_speed      rpm = least + (largest - least) (1 + action) / 2
        thrust           thrust = least + (largest - least) (1 + action) / 2

    The action is clipped to [-1, 1], and the result to the motor's range. With an action_scale above 1 a rotor has its
    least speed already before action -1.

    Args:
        vehicle: its rotors' range and its convention.
        action: of any shape.
        numpy: jax.numpy, or numpy for float64 outside of compiled code.
    """
    least, largest = vehicle.minimum_rotor_speed_rpm, vehicle.top_rotor_speed_rpm
    if isinstance(vehicle, TrueVehicle):
        return numpy.clip(commanded_rotor_speed(vehicle.nominal, action, numpy), least, largest)
    action = numpy.clip(action, -1.0, 1.0)
    if vehicle.action_scale is not None:
        return numpy.clip(vehicle.hover_rotor_speed_rpm * (1 + vehicle.action_scale * action), least, largest)
    share = (1 + action) / 2
    if vehicle.action_convention == "rotor_speed":
        return least + (largest - least) * share
    low, high = vehicle.square_of_speed(least), vehicle.square_of_speed(largest)
    return vehicle.speed_of_square(low + (high - low) * share)


def action_of_rotor_speed(vehicle: Vehicle, rotor_speed_rpm: Any) -> Any:
    """The action that asks for a rotor speed, see `commanded_rotor_speed`; beyond [-1, 1] outside of the range."""
    if vehicle.action_scale is not None:
        return (rotor_speed_rpm / vehicle.hover_rotor_speed_rpm - 1) / vehicle.action_scale
    least, largest = vehicle.minimum_rotor_speed_rpm, vehicle.top_rotor_speed_rpm
    if vehicle.action_convention == "thrust":
        least, largest, rotor_speed_rpm = map(vehicle.square_of_speed, (least, largest, rotor_speed_rpm))
    return 2 * (rotor_speed_rpm - least) / (largest - least) - 1


def hover_action(vehicle: Vehicle) -> Any:
    """The action of each motor that hovers: 0 with the convention hover_relative.

    Of a `TrueVehicle` it is the one that would hover as its controller was told.
    """
    if isinstance(vehicle, TrueVehicle):
        return hover_action(vehicle.nominal)
    return 0.0 if vehicle.action_scale is not None else action_of_rotor_speed(vehicle, vehicle.hover_rotor_speed_rpm)


def rotor_speed_per_action(vehicle: Vehicle) -> Any:
    """How much faster a rotor turns per unit of its action about hover, in rpm."""
    hover = vehicle.hover_rotor_speed_rpm
    if vehicle.action_scale is not None:
        return hover * vehicle.action_scale
    least, largest = vehicle.minimum_rotor_speed_rpm, vehicle.top_rotor_speed_rpm
    if vehicle.action_convention == "rotor_speed":
        return (largest - least) / 2
    return (vehicle.square_of_speed(largest) - vehicle.square_of_speed(least)) / 2 / square_per_rotor_speed(vehicle)


def square_per_rotor_speed(vehicle: Vehicle) -> Any:
    """The slope of `Vehicle.square_of_speed` at hover in rpm."""
    return 2 * vehicle.hover_rotor_speed_rpm + _given(vehicle.thrust_linear) / vehicle.thrust_coefficient


def _given(value: Any) -> Any:
    return 0.0 if value is None else value


def signed_sum(signs: Components, values: Components) -> Any:
    """The sum of values with these signs, without a multiplication."""
    total = values[0] if signs[0] > 0 else -values[0]
    for sign, value in zip(signs[1:], values[1:], strict=True):
        total = total + value if sign > 0 else total - value
    return total
