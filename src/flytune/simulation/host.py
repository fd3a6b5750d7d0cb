"""The rollout on the host: episodes stepped one control period at a time, in any simulator, behind NumPy arrays.

It serves simulators that JAX cannot differentiate, and interfaces that ask for one step at a time. In a call of
compiled code, each array that goes in or comes out costs more time than the arithmetic: so the task's numbers, the
episodes and the report are one array of float32 each, which holds the whole numbers among them exactly.
"""

import dataclasses
import math
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from flytune.errors import BadInput
from flytune.kernels.batched import batched
from flytune.physics.dynamics import hovering, no_pending_actions
from flytune.physics.rotors import hover_action
from flytune.simulation import environment
from flytune.simulation.environment import Episode
from flytune.simulation.rollout import reset_all
from flytune.simulation.simulator import WIDTH, Simulator, VehicleStates, state_from, state_numbers
from flytune.task.observation import NOISY, SIZE
from flytune.task.task import Task

Noise = Float[np.ndarray, "13 N"] | Float[Array, "13 N"]


def _vectors(block: int) -> Any:
    """A property: the vectors [N, 17] of one block of a report."""
    rows = slice(WIDTH * block, WIDTH * (block + 1))
    return property(lambda self: self.report[..., rows, :].swapaxes(-1, -2).copy())


def _numbers(row: int, kind: type = float) -> Any:
    """A property: the numbers [N] of one row of a report behind its four blocks."""
    return property(lambda self: self.report[..., 4 * WIDTH + row, :].astype(kind))


@dataclasses.dataclass(frozen=True, eq=False)
class Transition:
    """The result of one step of N episodes; with `restart`, one that ended has already begun its next episode.

    The parts are computed from the report when they are asked for, since most callers need few of them. The reports of
    T steps, stacked, give all parts with a first axis of time.
    """

    report: np.ndarray  # [..., rows, N], see `_step`
    term_names: tuple[str, ...]
    holds: bool = False  # a crashed vehicle stays where it was

    observation = _vectors(0)  # [N, 17] the next one, of the new episode where the old one ended
    final_observation = _vectors(1)  # [N, 17] of the state the action led to, before any new episode
    states = _vectors(2)  # [N, 17] of `observation`: position, attitude, velocity, body rate, rotor speeds in rpm
    placed = _vectors(3)  # [N, 17] states for a simulator without `physics`, where an episode is over
    reward = _numbers(0)  # [N]
    cause = _numbers(1, int)  # [N] why an episode failed, an index into `causes(task.termination)`, or SAFE
    truncated = _numbers(2, bool)  # [N] the horizon is reached; the rewards that would follow still count
    episode_return = _numbers(3)  # [N] sum of the rewards of the episode, this step included
    episode_length = _numbers(4, int)  # [N] steps of the episode, this one included
    over = _numbers(5, bool)  # [N] the episode is over by the rule of the environment: ended, or with `hold` crashed

    @property
    def terminated(self) -> np.ndarray:
        """Which episodes failed, [N] bool; nothing comes after."""
        return self.cause >= 0

    @property
    def ended(self) -> np.ndarray:
        """Which episodes are over by a termination or by the horizon, [N] bool."""
        return self.terminated | self.truncated

    @property
    def crashed(self) -> np.ndarray:
        """Which vehicles have crashed, in this step or before, [N] bool; with `hold` only."""
        return self.over & self.holds

    @property
    def terms(self) -> dict[str, np.ndarray]:
        """The reward of each term, [N] each; they add up to `reward`."""
        rewards = self.report[..., 4 * WIDTH + 6 :, :].astype(float)
        return {name: rewards[..., index, :] for index, name in enumerate(self.term_names)}


def _stay(family: Any, before: Episode, moved: Episode, outcome: Any, key: None) -> tuple[Episode, Array]:
    return moved, outcome.terminated | outcome.truncated


ENDINGS: dict[str, Callable[..., Any]] = {
    "restart": environment.restart,  # an episode that is over is followed by a new one
    "hold": environment.hold,  # a crashed vehicle stays where it was
    "none": _stay,  # the caller decides what follows
}


class HostEnvironment:
    """N episodes of one task in one simulator, which step together.

    In flytune's own simulator, only `episodes`, `key` and `observation` change: with these restored, it goes on exactly
    as before.

    Args:
        task: of the episodes.
        simulator: of N vehicles.
        number: N.
        ending: what follows the end of an episode, one of `ENDINGS`.

    Raises:
        BadInput: a task with dials, whose settings this rollout does not draw.
    """

    def __init__(self, task: Task, simulator: Simulator, number: int, ending: str = "restart") -> None:
        if task.dial:
            raise BadInput(
                f"task: {task.name} has a dial, which one environment cannot turn. Allowed: the task at one setting, "
                "load_task(...).at({'NAME': value})."
            )
        self.task, self.number, self.simulator = task, number, simulator
        self._numbers, self._structure = _packed(task)
        self._ending = ending
        self._hover = float(hover_action(task.vehicle))
        self._terms = tuple(sorted(task.reward))
        self.key: Any = None  # of noise and new episodes, where `step` is given none
        self.episodes: Any = np.zeros((0, number), np.float32)  # [K, N], see `unravel`
        self.observation = np.zeros((number, SIZE), np.float32)
        self.states = np.zeros((number, WIDTH), np.float32)
        self._parked = np.zeros(number, bool)

    def reset(self, seed: int | None = None, which: np.ndarray | None = None) -> np.ndarray:
        """The observation [N, 17] after new episodes of those in the mask `which` [N], all where None.

        A seed makes everything that follows reproducible; without one the random numbers go on.
        """
        if seed is not None:
            self.key = jax.random.key(seed)
        self.key, episodes, report = _draw(self._structure, self.number, self._numbers, self.key)
        return self._take(episodes, np.array(report), which)

    def start(self, episodes: Any, noise: Noise | None = None, which: np.ndarray | None = None) -> np.ndarray:
        """The observation [N, 17] after given episodes [K, N] of those in the mask `which` [N], all where None.

        `draw_episodes` and `episodes_at` make episodes. The noise is as in `step`.
        """
        if noise is None:
            self.key, key = jax.random.split(self.key)
            noise = jax.random.normal(key, (NOISY, self.number))
        return self._take(episodes, np.array(_look(self._structure, self._numbers, episodes, noise)), which)

    def _take(self, episodes: Any, report: np.ndarray, which: np.ndarray | None) -> np.ndarray:
        seen, states = report[:SIZE].T.copy(), report[SIZE:].T.copy()
        if which is not None:
            episodes = jnp.where(which, episodes, self.episodes)
            seen = np.where(which[:, None], seen, self.observation)
            states = np.where(which[:, None], states, self.states)
        self.episodes, self.observation, self.states = episodes, seen, states
        self._parked = np.zeros(self.number, bool)
        if self.simulator.physics is None:
            chosen = None if which is None else np.flatnonzero(which)
            self.simulator.place(VehicleStates.from_rows(states if chosen is None else states[chosen]), chosen)
        return self.observation

    def step(self, action: np.ndarray, noise: Noise | None = None) -> Transition:
        """The result of actions [N, 4]; they are clipped to [-1, 1].

        The noise is 13 standard normal numbers for each observation, drawn with the environment's own key where None.
        """
        physics, reached = self.simulator.physics, None
        action = np.asarray(action, np.float32)
        if physics is None:
            self.simulator.advance(np.where(self._parked[:, None], self._hover, action))
            reached = self.simulator.states().rows().astype(np.float32).T
        how = (self._structure, self._ending, physics)
        key = self.key if noise is None or self._ending == "restart" else None
        self.key, self.episodes, report = _step(*how, self._numbers, self.episodes, key, action, noise, reached)
        transition = Transition(np.array(report), self._terms, self._ending == "hold")
        self.observation, self.states = transition.observation, transition.states
        if physics is None and self._ending != "none":
            over = transition.over
            new = np.flatnonzero(over & ~self._parked)
            if len(new):
                self.simulator.place(VehicleStates.from_rows(transition.placed[new]), new)
            if self._ending == "hold":
                self._parked = over
        return transition

    def __getstate__(self) -> dict[str, Any]:
        """What a copy, or another process, needs to go on exactly."""
        if self.simulator.physics is None:
            raise BadInput(
                f"{type(self.simulator).__name__}: its vehicles cannot be copied or pickled. Allowed: the simulator "
                "flytune. Make another environment, and reset it with the same seed."
            )
        state = {name: value for name, value in self.__dict__.items() if name != "_structure"}
        key = None if self.key is None else np.asarray(jax.random.key_data(self.key))
        return state | {"key": key, "episodes": np.asarray(self.episodes), "_numbers": np.asarray(self._numbers)}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Go on with what `__getstate__` gave."""
        self.__dict__ |= state
        self._structure = _packed(self.task)[1]
        self.key = None if self.key is None else jax.random.wrap_key_data(jnp.asarray(self.key))

    def steps(self) -> np.ndarray:
        """How many steps old each episode is, [N] int."""
        return np.asarray(_steps(self._structure, self._numbers, self.episodes)).astype(int)

    def close(self) -> None:
        """Free the memory of the simulator."""
        self.simulator.close()


@jax.jit
def draw_episodes(task: Task, keys: Array) -> Array:
    """New episodes [K, N] drawn with keys [N]."""
    return ravel(reset_all(task, keys))


@jax.jit
def episodes_at(task: Task, states: Float[Array, "17 N"]) -> Array:
    """Episodes [K, N] that begin in given states."""

    def one(numbers: Array) -> Episode:
        pending = no_pending_actions(task.vehicle)
        return environment.begin(task.vehicle, state_from(numbers, pending))

    return ravel(jax.vmap(one, in_axes=-1, out_axes=-1)(states))


def ravel(episodes: Episode) -> Array:
    """Episodes as one array [K, N]."""
    return jax.vmap(lambda episode: ravel_pytree(episode)[0], in_axes=-1, out_axes=-1)(episodes)


def unravel(task: Task, numbers: Array) -> Episode:
    """The episodes of an array [K, N]; which key draws the example does not matter, and it is never drawn."""
    back = ravel_pytree(environment.reset(task, jax.random.key(0)))[1]
    return jax.vmap(back, in_axes=-1, out_axes=-1)(numbers)


def _packed(task: Task) -> tuple[Array, Any]:
    """The numbers of a task as one array, and its structure with the shapes of its leaves."""
    leaves, structure = jax.tree.flatten(task)
    numbers = np.concatenate([np.ravel(leaf) for leaf in leaves]).astype(np.float32)
    return jnp.asarray(numbers), (structure, tuple(np.shape(leaf) for leaf in leaves))


def _unpacked(structure: Any, numbers: Array) -> Task:
    """The task of an array of its numbers."""
    form, shapes = structure
    ends = np.cumsum([math.prod(shape) for shape in shapes]).tolist()
    starts = [0, *ends[:-1]]
    parts = zip(shapes, starts, ends, strict=True)
    leaves = [numbers[start:end].reshape(shape) if shape else numbers[start] for shape, start, end in parts]
    return jax.tree.unflatten(form, leaves)


def _seen(task: Task, episodes: Episode, noise: Any) -> Float[Array, "17 N"]:
    return batched(environment.observe, task)(episodes, noise)


@partial(jax.jit, static_argnums=(0, 1))
def _draw(structure: Any, number: int, numbers: Array, key: Array) -> tuple[Array, Array, Array]:
    task = _unpacked(structure, numbers)
    key, start_key, noise_key = jax.random.split(key, 3)
    episodes = reset_all(task, jax.random.split(start_key, number))
    seen = _seen(task, episodes, jax.random.normal(noise_key, (NOISY, number)))
    return key, ravel(episodes), jnp.concatenate([seen, state_numbers(episodes.state)])


@partial(jax.jit, static_argnums=0)
def _look(structure: Any, numbers: Array, episodes: Array, noise: Any) -> Array:
    task = _unpacked(structure, numbers)
    begun = unravel(task, episodes)
    return jnp.concatenate([_seen(task, begun, noise), state_numbers(begun.state)])


@partial(jax.jit, static_argnums=0)
def _steps(structure: Any, numbers: Array, episodes: Array) -> Array:
    return unravel(_unpacked(structure, numbers), episodes).steps


@partial(jax.jit, static_argnums=(0, 1, 2))
def _step(
    structure: Any,
    ending: str,
    physics: Any,
    numbers: Array,
    episodes: Array,
    key: Array | None,
    action: Array,
    noise: Any,
    reached: Array | None,
) -> tuple[Array | None, Array, Array]:
    """The key, the episodes after a step, and the report of a `Transition`."""
    task, number = _unpacked(structure, numbers), action.shape[0]
    before, keys = unravel(task, episodes), None
    if key is not None:
        key, noise_key, start_key = jax.random.split(key, 3)
        noise = jax.random.normal(noise_key, (NOISY, number)) if noise is None else noise
        keys = jax.random.split(start_key, number) if ending == "restart" else None

    def one(task: Task, episode: Episode, action: Array, elsewhere: Any, key: Any) -> Any:
        if elsewhere is None:
            moved, outcome = environment.step(task, episode, action, physics)
        else:  # pending actions stay in the simulator
            state = state_from(elsewhere, episode.state.pending_actions)
            moved, outcome = environment.assess(task, episode, state, jnp.clip(action, -1.0, 1.0))
        return *ENDINGS[ending](task, episode, moved, outcome, key), moved, outcome

    after, over, moved, outcome = batched(one, task)(before, action.T, reached, keys)
    seen = _seen(task, after, noise)
    final = _seen(task, moved, noise) if ending == "restart" else seen
    states = placed = state_numbers(after.state)
    if ending == "hold":  # where the simulator has no trouble with a crashed vehicle
        at_target = state_numbers(hovering(task.vehicle, task.reference(0).position))
        placed = jnp.broadcast_to(at_target[:, None], states.shape)
    results = [outcome.reward, outcome.cause, outcome.truncated, moved.reward, moved.steps, over]
    results += [outcome.terms[name] for name in sorted(outcome.terms)]
    rows = jnp.stack([each.astype(jnp.float32) for each in results])
    return key, ravel(after), jnp.concatenate([seen, final, states, placed, rows])
