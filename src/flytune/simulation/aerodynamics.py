"""Ground effect, and drag along the body's axes. NumPy, float64."""

import numpy as np
from jaxtyping import Float

from flytune.physics.dynamics import RAD_PER_S
from flytune.physics.rotors import places
from flytune.physics.vehicle import Vehicle
from flytune.simulation.simulator import rotation_matrix, to_body

LARGEST_GROUND_EFFECT = 4 / 15  # of the thrust: at gym-pybullet-drones' lowest height, r sqrt(15 k / 4) / 4
TINY = 1e-9  # m, where a vehicle without ground effect stands on the floor


def ground_effect(
    vehicle: Vehicle, position: Float[np.ndarray, "N 3"], attitude: Float[np.ndarray, "N 4"]
) -> Float[np.ndarray, "N 4"]:
    """The share by which each propeller's thrust grows above a floor at z = 0.

        gain = min(4 / 15, k (r / 4 h)^2),  h the height of the propeller, r its radius, k the vehicle's coefficient

    A vehicle upside down has no gain. The floor does not stop a vehicle: below it the gain stays at its largest.

    Source: Panerati et al., Learning to Fly, IROS 2021, after Shi et al., Neural Lander, ICRA 2019; the lowest
    height as in gym-pybullet-drones.
    """
    coefficient = float(vehicle.ground_effect or 0.0)
    upwards = rotation_matrix(attitude)[:, 2]
    height = position[:, 2:] + upwards[:, :2] @ places(vehicle).T
    lowest = vehicle.propeller_radius / 4 * np.sqrt(coefficient / LARGEST_GROUND_EFFECT)
    gain = coefficient * (vehicle.propeller_radius / (4 * np.maximum(height, max(lowest, TINY)))) ** 2
    return np.where(upwards[:, 2:] > 0, gain, 0.0)


def drag(
    vehicle: Vehicle,
    attitude: Float[np.ndarray, "N 4"],
    velocity: Float[np.ndarray, "N 3"],
    rotor_speed_rpm: Float[np.ndarray, "N 4"],
) -> Float[np.ndarray, "N 3"]:
    """The drag along the body's axes in N, body frame; `physics.dynamics.body_drag` has the equation.

    Args:
        vehicle: its coefficients, 0 where it has none.
        attitude: body to inertial.
        velocity: in m/s, inertial frame.
        rotor_speed_rpm: of each rotor.
    """
    along = to_body(attitude, velocity)
    linear, turning, quadratic = (
        np.array(each or (0.0, 0.0, 0.0)) for each in (vehicle.body_drag, vehicle.rotor_drag, vehicle.quadratic_drag)
    )
    speed = RAD_PER_S * rotor_speed_rpm.sum(axis=-1, keepdims=True)
    return -(linear + turning * speed + quadratic * np.abs(along)) * along
