"""flytune's own simulator as a world like any other: to fly side by side with the others, and to test what flies."""

from functools import partial
from typing import Annotated

import jax
import jax.numpy as jnp
import numpy as np
from annotated_types import Ge, Le, Unit

from flytune.config.document import Whole
from flytune.config.pytree import pytree, static
from flytune.physics import dynamics
from flytune.physics.dynamics import PHYSICS_STEPS, State
from flytune.physics.vehicle import Vehicle
from flytune.simulation.simulator import VehicleStates


@pytree
class JaxSimulatorOptions:
    """How finely flytune's own physics is stepped."""

    physics_steps: Annotated[Whole, Ge(1), Le(100), Unit("per control period")] = static(default=PHYSICS_STEPS)


class JaxSimulator:
    """N vehicles under `physics.dynamics`, in float32."""

    def __init__(self, vehicle: Vehicle, number: int, options: JaxSimulatorOptions) -> None:
        self._vehicle = vehicle
        self._physics_steps = options.physics_steps
        hovering = dynamics.hovering(vehicle, (0.0, 0.0, 0.0))
        self._state = jax.tree.map(lambda part: np.repeat(np.asarray(part)[None], number, axis=0), hovering)

    def place(self, body: VehicleStates, which: np.ndarray | None = None) -> None:
        """Put the vehicles there, see `World`."""
        chosen = slice(None) if which is None else which
        placed = State(
            position=_components(body.position),
            attitude=_components(body.attitude),
            velocity=_components(body.velocity),
            body_rate=_components(body.body_rate),
            rotor_speed_rpm=_components(body.rotor_speed_rpm),
            pending_actions=jnp.zeros((len(body.position), self._vehicle.action_latency_steps, 4)),
        )

        def put(old: np.ndarray, new: np.ndarray) -> np.ndarray:
            result = np.array(old)
            result[chosen] = new
            return result

        self._state = jax.tree.map(put, self._state, placed)

    def advance(self, action: np.ndarray) -> None:
        """Let one control period pass, see `World`."""
        self._state = _advance(self._vehicle, self._state, jnp.asarray(action, jnp.float32), self._physics_steps)

    def body(self) -> VehicleStates:
        """Where the vehicles are, see `World`."""
        state = self._state
        parts = (state.position, state.attitude, state.velocity, state.body_rate, state.rotor_speed_rpm)
        position, attitude, velocity, body_rate, rotor_speed = (
            np.stack([np.asarray(component, float) for component in part], axis=-1) for part in parts
        )
        return VehicleStates(
            position=position,
            attitude=attitude,
            velocity=velocity,
            body_rate=body_rate,
            rotor_speed_rpm=rotor_speed,
        )

    def close(self) -> None:
        """Nothing to give back."""


def _components(array: np.ndarray) -> tuple[np.ndarray, ...]:
    return tuple(np.asarray(array, np.float32).T)


@partial(jax.jit, static_argnames="physics_steps")
def _advance(vehicle: Vehicle, state: State, action: jax.Array, physics_steps: int) -> State:
    def one(state: State, action: jax.Array) -> State:
        return dynamics.step(vehicle, state, jnp.clip(action, -1.0, 1.0), physics_steps)

    return jax.vmap(one)(state, action)
