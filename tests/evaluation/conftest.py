"""Flights made by hand: what is not said is a quadrotor that hovers on its target, level and still."""

import numpy as np
import pytest

from flytune.evaluation.flights import Flights

TARGET = np.array([0.0, 0.0, 1.0])


@pytest.fixture
def time():
    """Ten seconds at 100 Hz, both ends included."""
    return np.arange(1001) / 100


@pytest.fixture
def make_flights(time):
    """Factory of Flights from position errors [N, K, 3] in m and yaw [N, K] in rad, at 100 Hz."""

    def make(error=None, *, yaw=None, time=time, trials=None, **changes):
        trials = trials or next((len(given) for given in (error, yaw) if given is not None), 1)
        shape = (trials, time.size)
        error = np.zeros((*shape, 3)) if error is None else error
        yaw = np.zeros(shape) if yaw is None else yaw
        attitude = np.stack([0 * yaw, 0 * yaw, np.sin(yaw / 2), np.cos(yaw / 2)], axis=-1)
        fields = {
            "time": time,
            "position": error + changes.get("target_position", TARGET),
            "attitude": attitude,
            "velocity": np.zeros((*shape, 3)),
            "body_rate": np.zeros((*shape, 3)),
            "rotor_speed_rpm": np.full((*shape, 4), 16_004.0),
            "action": np.zeros((*shape, 4)),
            "crashed": np.zeros(trials, dtype=bool),
            "margins": {},
            "target_position": TARGET,
            "target_yaw": 0.0,
            "speed_bound": 0.8,
            "name": "pid",
            "task": "baseline",
            "vehicle": "crazyflie",
            "simulator": "flytune",
            "seed": 1,
            "initial_conditions": "clear",
        }
        return Flights(**(fields | changes))

    return make
