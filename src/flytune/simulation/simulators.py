"""Simulators by name."""

from collections.abc import Mapping
from typing import Any

from flytune.config import document
from flytune.errors import BadInput
from flytune.physics.vehicle import Vehicle
from flytune.simulation.simulator import Simulator

SIMULATORS = {
    "flytune": "The equations of motion in JAX, differentiable; policies are trained in it.",
    "pybullet": "PyBullet, as an independent witness; needs the extra flytune[pybullet].",
    "mujoco": "MuJoCo, as an independent witness; needs the extra flytune[mujoco].",
}


def make_simulator(name: str, vehicle: Vehicle, number: int, options: Mapping[str, Any] | None = None) -> Simulator:
    """A simulator with `number` vehicles of one kind; `place` gives them their states.

    Args:
        name: one of `SIMULATORS`.
        vehicle: the model of each.
        number: of vehicles, 1 or more.
        options: of that simulator: `PyBulletOptions`, `MujocoOptions` or `JaxSimulatorOptions`.

    Raises:
        BadInput: an unknown name, an option that is unknown or out of range, or a simulator that is not installed.
    """
    if number < 1:
        raise BadInput(f"number: {number} is not allowed. Allowed: a whole number, 1 or more.")
    match name:  # imported where they are needed: the simulators are optional
        case "flytune":
            from flytune.simulation.jax_simulator import JaxSimulator, JaxSimulatorOptions

            return JaxSimulator(vehicle, number, _read(JaxSimulatorOptions, name, options))
        case "pybullet":
            from flytune.simulation.pybullet_simulator import PyBulletOptions, PyBulletSimulator

            return PyBulletSimulator(vehicle, number, _read(PyBulletOptions, name, options))
        case "mujoco":
            from flytune.simulation.mujoco_simulator import MujocoOptions, MujocoSimulator

            return MujocoSimulator(vehicle, number, _read(MujocoOptions, name, options))
    raise BadInput(f"world: {name!r} is not allowed. Allowed: {', '.join(SIMULATORS)}.")


def _read(kind: Any, name: str, options: Mapping[str, Any] | None) -> Any:
    return document.read(kind, options or {}, where=f"world {name}")
