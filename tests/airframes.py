"""Airframes from 20 g to 25 kg as a user would type them in, for the tests of every room."""

from typing import Any

from flytune.config import document
from flytune.physics.vehicle import Vehicle

_SHARED = {
    "drag": [0.0, 0.0, 0.0],
    "gravity": 9.81,
    "action_scale": 0.5,
    "motor_rise_time_constant": 0.02,
    "motor_fall_time_constant": 0.02,
    "action_latency_steps": 0,
}
AIRFRAMES: dict[str, dict[str, Any]] = {
    # flightning, example_quad
    "flightning": _SHARED | {
        "mass": 0.2, "inertia": [1.4e-4, 1.6e-4, 2e-4], "arm": 0.0565685, "thrust_coefficient": 2.1932454e-9,
        "torque_coefficient": 1.7545963e-11, "propeller_radius": 0.04, "maximum_rotor_speed_rpm": 42016.9,
        "motor_rise_time_constant": 0.033, "motor_fall_time_constant": 0.033,
    },
    # rotorpy, hummingbird in x configuration
    "hummingbird x": _SHARED | {
        "mass": 0.5, "inertia": [0.00365, 0.00368, 0.00703], "arm": 0.17, "thrust_coefficient": 6.1081885e-8,
        "torque_coefficient": 1.4914069e-9, "propeller_radius": 0.1, "maximum_rotor_speed_rpm": 14323.9,
        "motor_rise_time_constant": 0.005, "motor_fall_time_constant": 0.005,
    },
    # gym-pybullet-drones, racer.urdf, whose propeller radius is that of a propeller of 10 inches
    "racer of ten inches": _SHARED | {
        "mass": 0.83, "inertia": [0.003113, 0.003113, 0.003113], "arm": 0.108541, "thrust_coefficient": 8.47e-9,
        "torque_coefficient": 2.13e-11, "propeller_radius": 0.127, "maximum_rotor_speed_rpm": 31657.0,
        "motor_rise_time_constant": 0.0, "motor_fall_time_constant": 0.0,
    },
    # PX4, x500, its base link alone with an arm
    "x500 base": _SHARED | {
        "mass": 2.064308, "inertia": [0.0216667, 0.0216667, 0.04], "arm": 0.246073, "thrust_coefficient": 9.374567e-8,
        "torque_coefficient": 1.4999307e-9, "propeller_radius": 0.128, "maximum_rotor_speed_rpm": 9549.3,
        "motor_rise_time_constant": 0.0125, "motor_fall_time_constant": 0.025,
    },
    # assumed, of the size of real ones: an indoor racer of 20 g, a racer with a thrust to weight of 12, a slow lifter
    "whoop": _SHARED | {
        "mass": 0.02, "inertia": [3e-6, 3e-6, 5e-6], "arm": 0.023, "thrust_coefficient": 6e-11,
        "torque_coefficient": 3e-13, "propeller_radius": 0.0155, "maximum_rotor_speed_rpm": 60000.0,
    },
    "five inches": _SHARED | {
        "mass": 0.5, "inertia": [2e-3, 2e-3, 3.5e-3], "arm": 0.11, "thrust_coefficient": 1.6e-8,
        "torque_coefficient": 2e-10, "propeller_radius": 0.0635, "maximum_rotor_speed_rpm": 40000.0,
        "action_scale": 2.46,
    },
    "lifter": _SHARED | {
        "mass": 25.0, "inertia": [1.2, 1.2, 2.0], "arm": 0.6, "thrust_coefficient": 4.9e-6,
        "torque_coefficient": 1.2e-7, "propeller_radius": 0.37, "maximum_rotor_speed_rpm": 5500.0,
        "motor_rise_time_constant": 0.2, "motor_fall_time_constant": 0.3,
        "drag": [1.0, 1.0, 1.5],
    },
}  # fmt: skip


def airframe(name: str) -> Vehicle:
    """One of them."""
    return document.read(Vehicle, {"name": name, **AIRFRAMES[name]})
