"""Vehicles from files of other programs: URDF, SDF, MJCF."""

from pathlib import Path

from flytune.errors import BadInput
from flytune.physics.found_vehicle import FoundVehicle
from flytune.simulation.reading import markup, mjcf, sdf, urdf

SUFFIXES = (".urdf", ".sdf", ".xml", ".jinja")


def read_model(path: Path) -> FoundVehicle:
    """The vehicle of a URDF, SDF or MJCF file; what it is, its root element says, not its name.

    Raises:
        BadInput: it cannot be read, or has no vehicle with four rotors.
    """
    root = markup.parse(path)
    match root.tag:
        case "robot":
            return urdf.read_urdf(root, markup.short_name(path))
        case "sdf":
            return sdf.read_sdf(root, path)
        case "mujoco":
            return mjcf.read_mjcf(path)
    raise BadInput(f"{path}: begins with <{root.tag}>. Allowed: robot (URDF), sdf (SDF), mujoco (MJCF).")
