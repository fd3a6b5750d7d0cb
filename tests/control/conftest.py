"""The observation of a state, without noise, and short flights that many tests fly."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from flytune.physics import dynamics, rotation
from flytune.task.files import load_task
from flytune.task.observation import observe


@pytest.fixture(scope="session")
def baseline():
    """The paper's baseline task."""
    return load_task("baseline")


@pytest.fixture(scope="session")
def observation():
    """Factory of noise-free observations [17] of a vehicle at a position and attitude (roll, pitch, yaw)."""
    see = jax.jit(lambda task, state, last: observe(task.reference(0), task.noise, state, last, jnp.zeros(13)))

    def make(task, position=None, angles=(0, 0, 0), velocity=(0, 0, 0), body_rate=(0, 0, 0), last_action=(0, 0, 0, 0)):
        place = task.target.position if position is None else position
        state = dynamics.hovering(task.vehicle, place, rotation.from_euler(*map(jnp.float32, angles)))
        moving = {"velocity": velocity, "body_rate": body_rate}
        state = dynamics.State(
            **{name: getattr(state, name) for name in ("position", "attitude", "rotor_speed_rpm", "pending_actions")},
            **{name: tuple(map(jnp.float32, value)) for name, value in moving.items()},
        )
        return see(task, state, jnp.asarray(last_action, float))

    return make


@pytest.fixture(scope="session")
def calm_flight():
    """States [N, T, 3 or 4] of noise-free flights of a controller from rest at positions [N, 3] and angles [N, 3]."""

    @partial(jax.jit, static_argnames="steps")
    def fly(controller, task, positions, angles, steps):
        def one(position, angle):
            def advance(carry, _):
                state, last, memory = carry
                memory, action = controller.act(
                    memory, observe(task.reference(0), task.noise, state, last, jnp.zeros(13))
                )
                state = dynamics.step(task.vehicle, state, action)
                return (state, action, memory), (state, action)

            start = dynamics.hovering(task.vehicle, tuple(position), rotation.from_euler(*angle))
            return jax.lax.scan(advance, (start, jnp.zeros(4), controller.initial_memory()), None, length=steps)[1]

        return jax.vmap(one)(positions, angles)

    def run(controller, task, positions, angles=None, steps=800):
        positions = jnp.atleast_2d(jnp.asarray(positions, float))
        angles = jnp.zeros_like(positions) if angles is None else jnp.atleast_2d(jnp.asarray(angles, float))
        states, actions = fly(controller, task, positions, angles, steps)
        parts = ("position", "attitude", "velocity", "body_rate")
        return {name: np.stack(getattr(states, name), axis=-1) for name in parts} | {"action": np.asarray(actions)}

    return run
