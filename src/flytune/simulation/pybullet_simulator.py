"""PyBullet as a simulator: the paper's simulator (paper R6), with a force at each motor."""

import dataclasses
import tempfile
from typing import Annotated

import numpy as np
from annotated_types import Ge, Le, Unit

from flytune.config.document import Real, Whole
from flytune.config.pytree import pytree, static
from flytune.errors import BadInput, require
from flytune.physics.dynamics import has_body_drag
from flytune.physics.rotors import drag_torque, places, spins, thrust
from flytune.physics.vehicle import Vehicle, inertia_matrix
from flytune.simulation.actuator import Actuator
from flytune.simulation.aerodynamics import drag, ground_effect
from flytune.simulation.model_files import urdf
from flytune.simulation.simulator import VehicleStates, rotate_attitude, to_body, to_inertial

NEEDED = {"ground_effect": "ground_effect = k", "rotor_drag": "optional_rotor_drag = [x, y, z] in kg/rad; 0 for none"}
BODY = -1  # PyBullet's index of a vehicle's base link


@pytree
class PyBulletOptions:
    """The effects that are simulated beside rigid bodies under thrust, and the number of physics steps."""

    physics_steps: Annotated[Whole, Ge(1), Le(100), Unit("per control period")] = static(default=2)
    # slows a free body by damping * (1 + |v|) * v, and its rotation alike; Bullet's own default is 0.04
    damping: Annotated[Real, Ge(0), Le(1), Unit("1/s")] = 0.0
    ground_effect: bool = static(default=False)  # propellers near a floor at z = 0 push harder
    rotor_drag: bool = static(default=False)  # the vehicle's optional rotor drag acts


class PyBulletSimulator:
    """N vehicles in one PyBullet client, without collisions, in float64; see `Simulator`.

    Bullet has the angular velocity in the inertial frame; it is turned into the body frame here. Its multibody solver,
    which URDF files use, includes the gyroscopic torque, advances velocities first and positions with them
    (semi-implicit Euler, first order), and clears forces after each step. docs/results/worlds.md has measurements.
    """

    physics = None

    def __init__(self, vehicle: Vehicle, number: int, options: PyBulletOptions) -> None:
        """An open client with the vehicles in it, all at the origin.

        Raises:
            BadInput: PyBullet is not installed, too many of its clients are open, or the vehicle lacks a coefficient.
        """
        if options.rotor_drag and vehicle.rotor_drag is None:
            vehicle = dataclasses.replace(vehicle, rotor_drag=vehicle.optional_rotor_drag)
        for effect in NEEDED:
            if getattr(options, effect) and getattr(vehicle, effect) is None:
                raise BadInput(
                    f"world pybullet: {effect}=true is not possible, since the vehicle {vehicle.name} does not say its "
                    f"{effect}. Give it in the vehicle's file ({NEEDED[effect]}), or leave the option out."
                )
        self._bullet = require("pybullet", "pybullet")
        self._vehicle, self._options = vehicle, options
        self._period = vehicle.control_period / options.physics_steps
        self._actuator = Actuator(vehicle, number)
        self._spins, self._drag = np.array(spins(vehicle)), np.array(vehicle.drag, float)
        # Bullet's link has the principal axes of inertia; `to_link` takes vectors of the body there
        moments, to_link = principal_axes(vehicle)
        self._motors = [(to_link @ [x, y, 0.0]).tolist() for x, y in places(vehicle).tolist()]
        self._up, self._to_link = to_link @ [0.0, 0.0, 1.0], to_link
        self._client = self._bullet.connect(self._bullet.DIRECT)
        if self._client < 0:
            raise BadInput("pybullet: no client is left. Close a simulator that is no longer needed.")
        self._bullet.setGravity(0, 0, -float(vehicle.gravity), physicsClientId=self._client)
        self._bullet.setTimeStep(self._period, physicsClientId=self._client)
        with tempfile.NamedTemporaryFile("w", suffix=".urdf", encoding="utf-8") as file:
            file.write(urdf(dataclasses.replace(vehicle, inertia=moments, products_of_inertia=None)))
            file.flush()
            self._vehicles = [self._load(file.name) for _ in range(number)]

    def _load(self, file: str) -> int:
        """PyBullet's number of a new vehicle."""
        bullet, damping = self._bullet, float(self._options.damping)
        flags = bullet.URDF_USE_INERTIA_FROM_FILE  # else Bullet computes the inertia from the collision shape
        vehicle = bullet.loadURDF(file, flags=flags, physicsClientId=self._client)
        bullet.changeDynamics(
            vehicle,
            BODY,
            linearDamping=damping,
            angularDamping=damping,
            activationState=bullet.ACTIVATION_STATE_DISABLE_SLEEPING,
            physicsClientId=self._client,
        )
        return vehicle

    def place(self, states: VehicleStates, which: np.ndarray | None = None) -> None:
        chosen = range(len(self._vehicles)) if which is None else which
        turning = to_inertial(np.asarray(states.attitude, float), np.asarray(states.body_rate, float))
        attitude = rotate_attitude(np.asarray(states.attitude, float), self._to_link.T)
        parts = (part.tolist() for part in (states.position, attitude, states.velocity, turning))
        for index, position, attitude, velocity, rate in zip(chosen, *parts, strict=True):
            vehicle = self._vehicles[int(index)]
            self._bullet.resetBasePositionAndOrientation(vehicle, position, attitude, physicsClientId=self._client)
            self._bullet.resetBaseVelocity(vehicle, velocity, rate, physicsClientId=self._client)
        self._actuator.place(states.rotor_speed_rpm, which)

    def advance(self, action: np.ndarray) -> None:
        self._actuator.command(action)
        for _ in range(self._options.physics_steps):
            self._push(self._actuator.turn(self._period))
            self._bullet.stepSimulation(physicsClientId=self._client)

    def _push(self, rotor_speed_rpm: np.ndarray) -> None:
        """Apply the forces of a physics step: a thrust at each motor, their torque about z, drag and ground effect."""
        bullet, client, frame = self._bullet, self._client, self._bullet.LINK_FRAME
        forces = thrust(self._vehicle, rotor_speed_rpm)
        if self._options.ground_effect or self._drag.any() or has_body_drag(self._vehicle):
            forces = self._resist(rotor_speed_rpm, forces)
        twist = drag_torque(self._vehicle, rotor_speed_rpm) @ self._spins
        for vehicle, pushes, torque in zip(self._vehicles, forces.tolist(), twist.tolist(), strict=True):
            for motor, force in zip(self._motors, pushes, strict=True):
                bullet.applyExternalForce(vehicle, BODY, (force * self._up).tolist(), motor, frame, client)
            bullet.applyExternalTorque(vehicle, BODY, (torque * self._up).tolist(), frame, client)

    def _resist(self, rotor_speed_rpm: np.ndarray, forces: np.ndarray) -> np.ndarray:
        """The thrusts with ground effect; drag is applied on the way."""
        body = self.states()
        pull = -self._drag * body.velocity
        if has_body_drag(self._vehicle):
            pull += to_inertial(body.attitude, drag(self._vehicle, body.attitude, body.velocity, rotor_speed_rpm))
        for vehicle, force, place in zip(self._vehicles, pull.tolist(), body.position.tolist(), strict=True):
            self._bullet.applyExternalForce(vehicle, BODY, force, place, self._bullet.WORLD_FRAME, self._client)
        if not self._options.ground_effect:
            return forces
        return forces * (1 + ground_effect(self._vehicle, body.position, body.attitude))

    def states(self) -> VehicleStates:
        bullet, client = self._bullet, self._client
        places = [bullet.getBasePositionAndOrientation(vehicle, client) for vehicle in self._vehicles]
        motions = np.array([bullet.getBaseVelocity(vehicle, client) for vehicle in self._vehicles])
        attitude = rotate_attitude(np.array([attitude for _, attitude in places]), self._to_link)
        return VehicleStates(
            position=np.array([position for position, _ in places]),
            attitude=attitude,
            velocity=motions[:, 0],
            body_rate=to_body(attitude, motions[:, 1]),
            rotor_speed_rpm=self._actuator.rotor_speed_rpm.copy(),
        )

    def close(self) -> None:
        """Disconnect; a second call does nothing."""
        if self._client >= 0:
            self._bullet.disconnect(physicsClientId=self._client)
            self._client = -1


def principal_axes(vehicle: Vehicle) -> tuple[tuple[float, float, float], np.ndarray]:
    """The principal moments of inertia in kg m^2, and the matrix that takes vectors of the body to their axes.

    Without products of inertia these are the body's own axes.
    """
    if vehicle.products_of_inertia is None:
        return vehicle.inertia, np.eye(3)
    moments, axes = np.linalg.eigh(inertia_matrix(vehicle))
    axes[:, 2] *= np.sign(np.linalg.det(axes))
    x, y, z = moments.tolist()
    return (x, y, z), axes.T
