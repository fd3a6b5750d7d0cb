"""One episode at a time behind a NumPy interface, in any world: one compiled call per step.

A call costs more per array that goes in or comes out than its arithmetic. So the task's numbers, the episode and the
report each cross as one vector of float32, which holds the whole numbers among them exactly.
"""

import dataclasses
from collections.abc import Mapping
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from flytune.physics import dynamics, rotation
from flytune.physics.components import pack, unpack
from flytune.physics.dynamics import State
from flytune.simulation import environment
from flytune.simulation.environment import Episode, Outcome
from flytune.simulation.simulator import Simulator, VehicleStates
from flytune.task.observation import SIZE
from flytune.task.task import Task

PARTS = {"position": 3, "attitude": 4, "velocity": 3, "body_rate": 3, "rotor_speed_rpm": 4}  # of a Body
BODY = sum(PARTS.values())


@dataclasses.dataclass(frozen=True, kw_only=True)
class Moment:
    """What one step brought, judged on the true state it led to."""

    observation: np.ndarray  # [17] with noise
    body: np.ndarray  # [17] position, attitude, velocity, body rate, rotor speeds in rpm, without noise
    reward: float
    terms: dict[str, float]  # the reward of each term; they add up to `reward`
    cause: int  # why the episode failed, an index into `causes(task.termination)`, or SAFE
    truncated: bool  # the horizon is reached; what would come after still counts


class Single:
    """One vehicle on one task, in flytune's own simulator or in a world that is not ours.

    Args:
        task: what is flown.
        world: None for flytune's own simulator, or a world with one vehicle in it.
    """

    def __init__(self, task: Task, simulator: Simulator | None = None) -> None:
        self.task, self._world = task, simulator
        leaves, structure = jax.tree.flatten(task)
        numbers = np.asarray(leaves, np.float32)
        self._begin = partial(_begin, structure, numbers)
        self._judge = partial(_judge if simulator else _step, structure, numbers)
        self._episode = np.zeros(0, np.float32)
        self.body = np.zeros(BODY, np.float32)

    def begin(self, seed: int, normal: np.ndarray, start: Mapping[str, Any] | None = None) -> np.ndarray:
        """The observation [17] after a new start.

        Args:
            seed: of the drawn start, 0 to 2^32 - 1.
            normal: 13 standard normal numbers for the noise of the observation.
            start: `position` in metres and `yaw` in radians, level and at rest, instead of a drawn one.
        """
        given = None if start is None else np.array([*start["position"], start["yaw"]], np.float32)
        report = np.array(self._begin(np.uint32(seed), given, normal))
        observation, self.body, self._episode = np.split(report, [SIZE, SIZE + BODY])
        if self._world is not None:
            self._world.place(VehicleStates(**{name: part[None] for name, part in parts(self.body).items()}))
        return observation

    def step(self, action: np.ndarray, normal: np.ndarray) -> Moment:
        """What an action [4] brought, seen through 13 standard normal numbers of noise; it is clipped to [-1, 1]."""
        if self._world is None:
            report = np.array(self._judge(self._episode, action, normal))
        else:
            self._world.advance(action[None])
            body = self._world.body()
            reached = np.concatenate([getattr(body, name)[0] for name in PARTS], dtype=np.float32)
            report = np.array(self._judge(self._episode, action, normal, reached))
        bounds = np.cumsum([SIZE, BODY, len(self._episode)])
        observation, self.body, self._episode, outcome = np.split(report, bounds)
        reward, why, truncated, *terms = outcome.tolist()
        return Moment(
            observation=observation,
            body=self.body,
            reward=reward,
            terms=dict(zip(sorted(self.task.reward), terms, strict=True)),
            cause=int(why),
            truncated=truncated > 0,
        )

    def close(self) -> None:
        """Give the world's memory back."""
        if self._world is not None:
            self._world.close()
            self._world = None


def parts(body: np.ndarray) -> dict[str, np.ndarray]:
    """The parts of a body's 17 numbers, by the names of `Body`."""
    cuts = np.cumsum(list(PARTS.values()))[:-1]
    return dict(zip(PARTS, np.split(body, cuts), strict=True))


@partial(jax.jit, static_argnums=0)
def _begin(structure: Any, numbers: jax.Array, seed: jax.Array, given: jax.Array | None, normal: jax.Array) -> Any:
    task = jax.tree.unflatten(structure, list(numbers))
    episode = environment.reset(task, jax.random.key(seed))
    if given is not None:
        x, y, z, yaw = unpack(given)
        zero = jnp.zeros(())
        state = dynamics.hovering(task.vehicle, (x, y, z), rotation.from_euler(zero, zero, yaw))
        episode = dataclasses.replace(episode, state=state)
    return _report(task, episode, normal)


@partial(jax.jit, static_argnums=0)
def _step(structure: Any, numbers: jax.Array, episode: jax.Array, action: jax.Array, normal: jax.Array) -> Any:
    task = jax.tree.unflatten(structure, list(numbers))
    after, outcome = environment.step(task, _unravel(task)(episode), action)
    return _report(task, after, normal, outcome)


@partial(jax.jit, static_argnums=0)
def _judge(
    structure: Any, numbers: jax.Array, episode: jax.Array, action: jax.Array, normal: jax.Array, body: jax.Array
) -> Any:
    task = jax.tree.unflatten(structure, list(numbers))
    before = _unravel(task)(episode)
    cuts = np.cumsum(list(PARTS.values()))[:-1]
    moved = {name: unpack(part) for name, part in zip(PARTS, jnp.split(body, cuts), strict=True)}
    state = State(**moved, pending_actions=before.state.pending_actions)  # the world keeps its own
    after, outcome = environment.judge(task, before, state, jnp.clip(action, -1.0, 1.0))
    return _report(task, after, normal, outcome)


def _unravel(task: Task) -> Any:
    """The way back from an episode's vector; which key draws the example does not matter, and it is never drawn."""
    return ravel_pytree(environment.reset(task, jax.random.key(0)))[1]


def _report(task: Task, episode: Episode, normal: jax.Array, outcome: Outcome | None = None) -> jax.Array:
    state = episode.state
    body = pack(tuple(number for name in PARTS for number in getattr(state, name)))
    parts = [environment.look(task, episode, normal), body, ravel_pytree(episode)[0]]
    if outcome is not None:
        terms = [outcome.terms[name] for name in sorted(outcome.terms)]
        numbers = [outcome.reward, outcome.cause, outcome.truncated, *terms]
        parts += [jnp.stack([number.astype(jnp.float32) for number in numbers])]
    return jnp.concatenate(parts)
