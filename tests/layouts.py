"""Vehicles with other layouts of rotors than the x configuration, for the tests of every room."""

import dataclasses

from flytune.physics.vehicle import Rotors, Vehicle, load_vehicle

LAYOUTS = {
    "plus": Rotors(place=((0.04, 0.0), (0.0, -0.04), (-0.04, 0.0), (0.0, 0.04)), spin=(-1, 1, -1, 1)),
    "long deck": Rotors(place=((0.07, -0.03), (-0.07, -0.03), (-0.07, 0.03), (0.07, 0.03)), spin=(1, -1, 1, -1)),
    "kite": Rotors(place=((0.06, 0.0), (-0.01, -0.05), (-0.04, 0.0), (-0.01, 0.05)), spin=(-1, 1, -1, 1)),
}


def with_layout(name: str, vehicle: str = "crazyflie") -> Vehicle:
    """A vehicle that ships, its rotors in another layout."""
    return dataclasses.replace(load_vehicle(vehicle), name=name, arm=None, rotors=LAYOUTS[name])
