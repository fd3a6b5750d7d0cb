"""The four rotors: their places, their spins, and their thrust and torque.

Everything that depends on the layout of the rotors takes it from here: the equations of motion, the allocation of
thrust and torque to rotors, the simulators' files, the ground effect and the picture.
"""

from typing import Any

import numpy as np
from jaxtyping import Float

from flytune.physics.components import Components
from flytune.physics.vehicle import Vehicle

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


def thrust(vehicle: Vehicle, squared_rotor_speed: Any) -> Any:
    """Thrust of a rotor in N from its squared speed in rpm^2: kf rpm^2 (paper R4)."""
    return vehicle.thrust_coefficient * squared_rotor_speed


def mixed(vehicle: Vehicle, squares: Components) -> tuple[Any, Components]:
    """Thrust along the body's z axis in N, and torque in the body frame in N m, of squared rotor speeds in rpm^2.

        f_i = kf rpm_i^2
        tau_x = sum y_i f_i,   tau_y = -sum x_i f_i,   tau_z = km sum spin_i rpm_i^2

    Negative squares are taken too, as a linear law may ask for them.

    Source: paper R4, where x and y of the rotors are l = arm / sqrt(2) in size.
    """
    roll, pitch, yaw = directions(vehicle)
    if vehicle.rotors is None:
        bending = vehicle.thrust_coefficient * vehicle.lever
        torque = (bending * _signed_sum(roll, squares), bending * _signed_sum(pitch, squares))
    else:
        torque = tuple(
            vehicle.thrust_coefficient * sum(arm * square for arm, square in zip(arms, squares, strict=True))
            for arms in (roll, pitch)
        )
    return thrust(vehicle, _signed_sum((1, 1, 1, 1), squares)), (
        *torque,
        vehicle.torque_coefficient * _signed_sum(yaw, squares),
    )


def thrust_and_torque(vehicle: Vehicle, rotor_speed_rpm: Components) -> tuple[Any, Components]:
    """Thrust in N and torque in N m of rotor speeds in rpm, see `mixed`."""
    return mixed(vehicle, tuple(speed * speed for speed in rotor_speed_rpm))


def _signed_sum(signs: Components, values: Components) -> Any:
    """The sum of values with these signs, without a multiplication."""
    total = values[0] if signs[0] > 0 else -values[0]
    for sign, value in zip(signs[1:], values[1:], strict=True):
        total = total + value if sign > 0 else total - value
    return total
