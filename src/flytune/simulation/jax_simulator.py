"""flytune's own simulator: its step in JAX for the rollout on the device, and the same step for a loop on the host."""

from functools import lru_cache, partial
from typing import Annotated

import jax
import jax.numpy as jnp
import numpy as np
from annotated_types import Ge, Le, Unit

from flytune.config.document import Whole
from flytune.config.pytree import pytree, static
from flytune.kernels.programs import program
from flytune.physics import dynamics
from flytune.physics.dynamics import PHYSICS_STEPS, State
from flytune.physics.rotors import hover_action
from flytune.physics.vehicle import Vehicle
from flytune.simulation.environment import Physics
from flytune.simulation.simulator import VehicleStates, state_from, state_numbers


@pytree
class JaxSimulatorOptions:
    """How finely the physics is stepped."""

    physics_steps: Annotated[Whole, Ge(1), Le(100), Unit("per control period")] = static(default=PHYSICS_STEPS)


class JaxSimulator:
    """N vehicles under `physics.dynamics`, in float32; see `Simulator`."""

    physics: Physics | None

    def __init__(self, vehicle: Vehicle, number: int, options: JaxSimulatorOptions | None = None) -> None:
        self.physics = self._step = _physics((options or JaxSimulatorOptions()).physics_steps)
        self._vehicle = vehicle
        hovering = np.asarray(_hovering(vehicle))
        self._numbers = np.repeat(hovering[:, None], number, axis=1)
        self._hover = float(hover_action(vehicle))
        self._pending = np.full((vehicle.action_latency_steps, 4, number), self._hover, np.float32)

    def place(self, states: VehicleStates, which: np.ndarray | None = None) -> None:
        chosen = slice(None) if which is None else which
        self._numbers, self._pending = np.array(self._numbers), np.array(self._pending)
        self._numbers[:, chosen] = states.rows().T
        self._pending[..., chosen] = self._hover

    def advance(self, action: np.ndarray) -> None:
        given = np.asarray(action, np.float32).T
        self._numbers, self._pending = _advance(self._step, self._vehicle, self._numbers, self._pending, given)

    def states(self) -> VehicleStates:
        return VehicleStates.from_rows(np.asarray(self._numbers, float).T)

    def close(self) -> None:
        """Nothing to free."""


@program()
def _hovering(vehicle: Vehicle) -> jax.Array:
    """The state [17] of a vehicle that hovers at the origin."""
    return state_numbers(dynamics.hovering(vehicle, (0.0, 0.0, 0.0)))


@lru_cache  # the same function for the same number, so that one compiled program serves every simulator
def _physics(physics_steps: int) -> Physics:
    return dynamics.step if physics_steps == PHYSICS_STEPS else partial(dynamics.step, physics_steps=physics_steps)


@partial(jax.jit, static_argnums=0)
def _advance(
    physics: Physics, vehicle: Vehicle, numbers: jax.Array, pending: jax.Array, action: jax.Array
) -> tuple[jax.Array, jax.Array]:
    def one(state: State, action: jax.Array) -> State:
        return physics(vehicle, state, jnp.clip(action, -1.0, 1.0))

    moved = jax.vmap(one, in_axes=-1, out_axes=-1)(state_from(numbers, pending), action)
    return state_numbers(moved), moved.pending_actions
