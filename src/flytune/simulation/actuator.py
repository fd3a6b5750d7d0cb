"""Rotors for simulators that take forces: from action to rotor speed, with lag and latency. NumPy, float64.

The equations are those of `physics.dynamics`, repeated because a simulator in C takes plain numbers and steps itself.
"""

import numpy as np
from jaxtyping import Float

from flytune.physics.rotors import commanded_rotor_speed, hover_action
from flytune.physics.vehicle import Vehicle


class Actuator:
    """The four rotors of each of N vehicles: their speeds, and the pending actions."""

    def __init__(self, vehicle: Vehicle, number: int) -> None:
        self._vehicle = vehicle
        hover = float(commanded_rotor_speed(vehicle, hover_action(vehicle), np))
        self.rotor_speed_rpm: Float[np.ndarray, "N 4"] = np.full((number, 4), hover)
        self._commanded = np.full((number, 4), hover)
        self._hover = float(hover_action(vehicle))
        self._pending = np.full((number, vehicle.action_latency_steps, 4), self._hover)  # oldest first

    def place(self, rotor_speed_rpm: Float[np.ndarray, "K 4"], which: np.ndarray | None = None) -> None:
        """Set the rotor speeds, with no pending action; see `Simulator.place`."""
        chosen = slice(None) if which is None else which
        self.rotor_speed_rpm[chosen] = rotor_speed_rpm
        self._pending[chosen] = self._hover

    def command(self, action: Float[np.ndarray, "N 4"]) -> None:
        """Accept the actions of a control period; those that the latency has delayed until now move the motors."""
        queue = np.concatenate([self._pending, np.asarray(action, float)[:, None]], axis=1)
        now, self._pending = queue[:, 0], queue[:, 1:]
        self._commanded = np.asarray(commanded_rotor_speed(self._vehicle, now, np))

    def turn(self, duration: float) -> Float[np.ndarray, "N 4"]:
        """The rotor speeds in rpm at the middle of the next `duration` seconds, which are simulated.

        A simulator that holds its forces through a step is of second order in the lag with the speeds of the middle,
        and of first order with those of either end.
        """
        middle = self._after(duration / 2)
        self.rotor_speed_rpm = self._after(duration)
        return middle

    def _after(self, elapsed: float) -> Float[np.ndarray, "N 4"]:
        """The exact first-order response: command + (speed - command) exp(-t / tau), see `rotor_speed_after`."""
        constants = self._vehicle.motor_rise_time_constant, self._vehicle.motor_fall_time_constant
        rise, fall = (float(np.exp(-elapsed / constant)) if constant > 0 else 0.0 for constant in constants)
        now, goal = self.rotor_speed_rpm, self._commanded
        return goal + (now - goal) * np.where(goal > now, rise, fall)
