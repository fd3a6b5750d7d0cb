"""Vehicles with everything that a Crazyflie lacks, for the tests of every room."""

import dataclasses

from tests.layouts import LAYOUTS

from flytune.physics.vehicle import Vehicle, load_vehicle

CURVES = {"thrust_linear": 1.2e-6, "torque_linear": -8e-9, "minimum_rotor_speed_rpm": 6000.0}
AIR = {"body_drag": (0.01, 0.02, 0.03), "quadratic_drag": (0.02, 0.01, 0.03), "rotor_drag": (9e-7, 7e-7, 3e-7)}
PRODUCTS = {"products_of_inertia": (3e-6, -2e-6, 4e-6)}
ODD: dict[str, dict] = {
    "curves": CURVES | {"control_rate": 50},
    "air": AIR | {"control_rate": 240},
    "skewed": PRODUCTS,
    "rotor speed": {"action_convention": "rotor_speed", "action_scale": None, "minimum_rotor_speed_rpm": 4000.0},
    "thrust": {
        "action_convention": "thrust", "action_scale": None, "maximum_rotor_speed_rpm": None, "thrust_to_weight": 2.0,
    },
    "everything": CURVES | AIR | PRODUCTS | {
        "action_convention": "thrust", "action_scale": None, "arm": None, "rotors": LAYOUTS["kite"],
        "control_rate": 500, "action_latency_steps": 2,
    },
}  # fmt: skip


def odd_vehicle(name: str) -> Vehicle:
    """The measured Crazyflie with such changes."""
    return dataclasses.replace(load_vehicle("crazyflie-measured"), name=name, **ODD[name])
