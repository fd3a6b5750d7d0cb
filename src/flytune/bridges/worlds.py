"""Worlds by name: whoever flies elsewhere asks here."""

from collections.abc import Mapping
from typing import Any

from flytune import document
from flytune.bridges.world import World
from flytune.errors import BadInput
from flytune.physics.vehicle import Vehicle

WORLDS = ("flytune", "pybullet", "mujoco")


def make_world(name: str, vehicle: Vehicle, number: int, options: Mapping[str, Any] | None = None) -> World:
    """A simulator with `number` vehicles of one kind in it; nobody has placed them yet.

    Args:
        name: one of WORLDS.
        vehicle: what is simulated.
        number: how many, 1 or more.
        options: of that simulator: `PyBulletOptions`, `MujocoOptions`, `FlytuneOptions`.

    Raises:
        BadInput: an unknown name, an option that is unknown or out of range, or a simulator that is not installed.
    """
    if number < 1:
        raise BadInput(f"number: {number} is not allowed. Allowed: a whole number, 1 or more.")
    match name:  # imported where they are needed: the simulators are optional
        case "flytune":
            from flytune.bridges.own import FlytuneOptions, FlytuneWorld

            return FlytuneWorld(vehicle, number, _read(FlytuneOptions, name, options))
        case "pybullet":
            from flytune.bridges.pybullet import PyBulletOptions, PyBulletWorld

            return PyBulletWorld(vehicle, number, _read(PyBulletOptions, name, options))
        case "mujoco":
            from flytune.bridges.mujoco import MujocoOptions, MujocoWorld

            return MujocoWorld(vehicle, number, _read(MujocoOptions, name, options))
    raise BadInput(f"world: {name!r} is not allowed. Allowed: {', '.join(WORLDS)}.")


def _read(kind: Any, name: str, options: Mapping[str, Any] | None) -> Any:
    return document.read(kind, options or {}, where=f"world {name}")
