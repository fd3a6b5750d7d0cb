"""MuJoCo as a simulator: the vehicle's MJCF, stepped for all vehicles at once."""

from typing import Annotated

import numpy as np
from annotated_types import Ge, Le, Unit

from flytune.config.document import Whole
from flytune.config.pytree import pytree, static
from flytune.errors import require
from flytune.physics.dynamics import has_body_drag
from flytune.physics.rotors import drag_torque, spins, thrust
from flytune.physics.vehicle import Vehicle
from flytune.simulation.actuator import Actuator
from flytune.simulation.aerodynamics import drag
from flytune.simulation.model_files import Integrator, has_curves, mjcf, torque_ratio
from flytune.simulation.simulator import VehicleStates, quaternion_product, to_inertial

POSITION, ATTITUDE = slice(1, 4), slice(4, 8)  # in MuJoCo's state (time, qpos, qvel) of one free body
VELOCITY, BODY_RATE = slice(8, 11), slice(11, 14)
W_FIRST, W_LAST = [3, 0, 1, 2], [1, 2, 3, 0]  # MuJoCo writes quaternions (w, x, y, z)


@pytree
class MujocoOptions:
    """How the motion is integrated, and how finely."""

    physics_steps: Annotated[Whole, Ge(1), Le(100), Unit("per control period")] = static(default=2)
    integrator: Integrator = static(default="RK4")


class MujocoSimulator:
    """N vehicles as N states of one MuJoCo model, in float64; see `Simulator`.

    A free joint has its velocity in the inertial frame and its angular velocity in the body frame, as flytune does. The
    vehicle's drag is set as damping on the three directions of the joint, so that MuJoCo's integrators include it.
    """

    physics = None

    def __init__(self, vehicle: Vehicle, number: int, options: MujocoOptions) -> None:
        """The compiled model, and the vehicles at its origin.

        Raises:
            BadInput: MuJoCo is not installed.
        """
        mujoco, self._rollout = require("mujoco", "mujoco"), require("mujoco.rollout", "mujoco")
        self._vehicle, self._options = vehicle, options
        self._period = vehicle.control_period / options.physics_steps
        text = mjcf(vehicle, timestep=self._period, integrator=options.integrator)
        self._model = mujoco.MjModel.from_xml_string(text)
        self._model.dof_damping[:3] = vehicle.drag
        self._data = mujoco.MjData(self._model)
        self._actuator = Actuator(vehicle, number)
        self._state = np.zeros((number, mujoco.mj_stateSize(self._model, mujoco.mjtState.mjSTATE_FULLPHYSICS)))
        self._state[:, ATTITUDE] = 1.0, 0.0, 0.0, 0.0

    def place(self, states: VehicleStates, which: np.ndarray | None = None) -> None:
        chosen = slice(None) if which is None else which
        self._state[chosen, POSITION] = states.position
        self._state[chosen, ATTITUDE] = states.attitude[:, W_FIRST]
        self._state[chosen, VELOCITY] = states.velocity
        self._state[chosen, BODY_RATE] = states.body_rate
        self._actuator.place(states.rotor_speed_rpm, which)

    def advance(self, action: np.ndarray) -> None:
        self._actuator.command(action)
        speeds = [self._actuator.turn(self._period) for _ in range(self._options.physics_steps)]
        if has_body_drag(self._vehicle):  # which depends on the states between
            for each in speeds:
                forces = self._forces(each)
                self._step(np.concatenate([forces, self._drag(each, forces)], axis=-1)[:, None])
        else:
            self._step(np.stack([self._forces(each) for each in speeds], axis=1))

    def _step(self, controls: np.ndarray) -> None:
        """Simulate as many physics steps as there are controls [N, steps, _]."""
        self._state[:, 0] = 0.0  # time, on which nothing depends
        states, _ = self._rollout.rollout(self._model, self._data, self._state, controls)
        self._state = np.array(states[:, -1])

    def _forces(self, rotor_speed_rpm: np.ndarray) -> np.ndarray:
        """The thrust of each rotor, and where the curves have linear parts the rest of the yaw torque."""
        vehicle = self._vehicle
        thrusts = thrust(vehicle, rotor_speed_rpm)
        if not has_curves(vehicle):
            return thrusts
        rest = drag_torque(vehicle, rotor_speed_rpm) - torque_ratio(vehicle) * thrusts
        return np.concatenate([thrusts, (rest @ np.array(spins(vehicle)))[:, None]], axis=-1)

    def _drag(self, rotor_speed_rpm: np.ndarray, forces: np.ndarray) -> np.ndarray:
        """The drag in the body frame, at the attitude and the velocity of the middle of the step, about."""
        now, half = self.states(), self._period / 2
        middle = now.attitude + half / 2 * quaternion_product(now.attitude, now.body_rate)
        middle /= np.linalg.norm(middle, axis=-1, keepdims=True)
        lift = np.zeros_like(now.velocity)
        lift[:, 2] = forces[:, :4].sum(axis=-1) / self._vehicle.mass
        slowing = drag(self._vehicle, now.attitude, now.velocity, rotor_speed_rpm) / self._vehicle.mass
        pull = (
            to_inertial(now.attitude, lift + slowing) - np.array(self._vehicle.drag) / self._vehicle.mass * now.velocity
        )
        pull[:, 2] -= self._vehicle.gravity
        return drag(self._vehicle, middle, now.velocity + half * pull, rotor_speed_rpm)

    def states(self) -> VehicleStates:
        state = self._state
        return VehicleStates(
            position=state[:, POSITION].copy(),
            attitude=state[:, ATTITUDE][:, W_LAST],
            velocity=state[:, VELOCITY].copy(),
            body_rate=state[:, BODY_RATE].copy(),
            rotor_speed_rpm=self._actuator.rotor_speed_rpm.copy(),
        )

    def close(self) -> None:
        """Free the model; a second call does nothing."""
        self._model = self._data = None
