"""The vehicles the physics tests fly, and one compiled open-loop flight for all of them."""

from functools import partial

import jax
import numpy as np
import pytest

from flytune.physics import dynamics
from flytune.physics.vehicle import load_vehicle


@pytest.fixture(scope="session")
def paper():
    """The paper's Crazyflie."""
    return load_vehicle("crazyflie")


@pytest.fixture(scope="session")
def measured():
    """The measured Crazyflie: drag, and motors that lag."""
    return load_vehicle("crazyflie-measured")


@pytest.fixture(scope="session")
def fly():
    """States after each of a row of actions [T, 4], as a State of NumPy arrays [T, ...]."""

    @partial(jax.jit, static_argnames="physics_steps")
    def scan(vehicle, start, actions, physics_steps):
        def advance(state, action):
            state = dynamics.step(vehicle, state, action, physics_steps)
            return state, state

        return jax.lax.scan(advance, start, actions)[1]

    def run(vehicle, start, actions, physics_steps=dynamics.PHYSICS_STEPS):
        states = scan(vehicle, start, jax.numpy.asarray(actions, float), physics_steps)
        return dynamics.State(
            **{name: np.stack(getattr(states, name), axis=-1) for name in PARTS},
            pending_actions=np.asarray(states.pending_actions),
        )

    return run


PARTS = ("position", "attitude", "velocity", "body_rate", "rotor_speed_rpm")
