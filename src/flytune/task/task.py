"""A task: target, initial states, noise, reward, terminations, vehicle and training settings, and families of tasks."""

import dataclasses
import re
from typing import Annotated, Any, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
from annotated_types import Ge, Gt, Le, Unit
from jaxtyping import Array, Float

from flytune.config import document
from flytune.config.document import Real, Whole
from flytune.config.formula import Formula
from flytune.config.pytree import label, pytree, with_field
from flytune.errors import BadInput
from flytune.physics.dynamics import CONTROL_PERIOD
from flytune.physics.vehicle import Vehicle
from flytune.task.dial import Dial, Input, Setting, checked_setting, number_of_inputs, told
from flytune.task.following import problem_of_dials, tables_at, words
from flytune.task.initial_state import InitialState
from flytune.task.observation import SIZE, ObservationNoise
from flytune.task.path_check import problem_of_path
from flytune.task.reference import Reference
from flytune.task.reward import RewardTerm
from flytune.task.target import Point, Target
from flytune.task.termination import Termination
from flytune.task.training_settings import ApgSettings, PpoSettings


@pytree
class Task:
    """What a controller has to do, with which vehicle, and how it is trained."""

    name: str = label(default="custom")
    horizon: Annotated[
        Whole, Ge(1), Le(1_000_000), Unit("control steps of 0.01 s")
    ]  # a training episode is truncated after these
    duration: Annotated[Real, Gt(0.5), Le(3600), Unit("s")] = label(default=10.0)  # of a trial in evaluation
    target: Target
    initial_state: InitialState
    noise: ObservationNoise
    reward: dict[str, RewardTerm]
    termination: dict[str, Termination]
    vehicle: Vehicle
    dial: dict[str, Dial] = dataclasses.field(default_factory=dict)  # numbers that may be set at any time
    follow: dict[str, Formula] = dataclasses.field(default_factory=dict)  # field path -> formula of the dials
    input: dict[str, Input] = dataclasses.field(default_factory=dict)  # what the controller is told of the dials
    ppo: PpoSettings = label(default_factory=PpoSettings)
    apg: ApgSettings = label(default_factory=ApgSettings)
    sources: dict[str, str] = label(default_factory=dict)

    def __repr__(self) -> str:
        terms, ends = " ".join(self.reward), " ".join(self.termination)
        return f"Task({self.name} on {self.vehicle.name}, reward: {terms}, termination: {ends})"

    def limit(self, quantity: str) -> float | None:
        """The tightest bound of the terminations on a quantity, in SI units, or None where none bounds it.

        `quantity` is altitude, distance, attitude_error, tilt, speed or body_rate.
        """
        limits = [float(end.limit) for end in self.termination.values() if end.quantity == quantity]
        return (max if quantity == "altitude" else min)(limits, default=None)

    @property
    def speed_bound(self) -> float | None:
        """The tightest bound on speed in m/s, or None where there is none."""
        return self.limit("speed")

    @property
    def inputs(self) -> int:
        """How many numbers a controller of this task is given: 17, and those of its dials."""
        return SIZE + number_of_inputs(self.input)

    def reference(self, steps: Any) -> Reference:
        """Where the target is after some control steps, and how it moves; a fixed one is the same at any time."""
        if isinstance(self.target, Point):
            return self.target.reference()
        return self.target.reference(jnp.maximum(steps, 0) * self.vehicle.control_period, self.vehicle.gravity)

    def draw(self, key: jax.Array) -> tuple[Any, jax.Array]:
        """The settings of the dials of one episode; without a dial nothing, and the key itself. See `TaskFamily`."""
        if not self.dial:
            return (), key
        key, *keys = jax.random.split(key, 1 + len(self.dial))
        return {name: self.dial[name].draw(each) for name, each in zip(sorted(self.dial), keys, strict=True)}, key

    def turn(self, numbers: Any, key: jax.Array) -> Any:
        """The settings of one episode before the next update: each dial is turned with its probability `turned`."""
        for index, name in enumerate(sorted(self.dial)):
            chance_key, value_key = jax.random.split(jax.random.fold_in(key, index))
            dial = self.dial[name]
            turned = jax.random.uniform(chance_key, ()) < dial.turned
            numbers = {**numbers, name: jnp.where(turned, dial.draw(value_key), numbers[name])}
        return numbers

    def member(self, numbers: Any) -> "Task":
        """The task at a setting of its dials, which all fields in `follow` follow; without a dial the task itself."""
        if not self.dial:
            return self
        fixed = dataclasses.replace(self, dial={}, follow={}, input={})
        numbers = jax.lax.stop_gradient(numbers)
        for path, formula in self.follow.items():
            fixed = with_field(fixed, tuple(path.split(".")), formula.value(numbers))
        return fixed

    def see(self, observation: Float[Array, "*batch 17"], numbers: Any) -> Float[Array, "*batch _"]:
        """What a controller is given of an observation at a setting: the observation and the inputs of the dials."""
        return told(self.input, observation, numbers) if self.input else observation

    def at(self, setting: Setting | None = None) -> "Task":
        """The fixed task at a setting of the dials, a dial that is not named at its default.

        Raises:
            BadInput: an unknown dial, a value out of range, or a field that would have a value that is not allowed.
        """
        return self.fixed_at(checked_setting(self.dial, setting or {})) if self.dial else self

    def fixed_at(self, setting: Setting, prefix: str = "") -> "Task":
        """The fixed task at a setting of all dials, every value checked.

        Raises:
            BadInput: a value is not allowed; the message begins with `prefix`.
        """
        tables = tables_at(document.plain(self), setting, prefix)
        try:
            return document.read(Task, tables)
        except BadInput as error:
            raise BadInput(f"{prefix}at {words(setting)}: {error}") from None

    def problem(self) -> str | None:
        """What makes the numbers impossible together, or None."""
        if not self.reward:
            return "reward: no term. Allowed: one or more tables [reward.NAME]."
        if not re.fullmatch(r"[\w .+-]{1,100}", self.name):
            return f"name: {self.name[:100]!r} cannot name a run. Allowed: up to 100 letters, digits and . _ + - signs."
        flown = max(float(self.duration), float(self.horizon) * CONTROL_PERIOD)
        return problem_of_dials(self.dial, self.follow, self.input) or self.problem_of_path(flown)

    def problem_of_path(self, duration: float) -> str | None:
        """What of the target's path cannot be flown for a duration in s within the bounds, or None."""
        vehicle = self.vehicle
        return problem_of_path(self.target, self.termination, vehicle.gravity, vehicle.full_thrust_to_weight, duration)


@runtime_checkable
class TaskFamily(Protocol):
    """Tasks of one structure that differ in numbers: a bound that a dial sets, a mass that is drawn per episode.

    A `Task` is the family of one: its `draw` draws nothing, and its `member` is the task itself.
    """

    def draw(self, key: jax.Array) -> tuple[Any, jax.Array]:
        """The numbers of one episode, a pytree of scalars, and the key that is left for its initial state."""
        ...

    def member(self, numbers: Any) -> Task:
        """The task with these numbers; inside compiled code they are tracers."""
        ...

    def see(self, observation: Float[Array, "*batch 17"], numbers: Any) -> Float[Array, "*batch _"]:
        """What a controller is given of an observation in an episode with these numbers."""
        ...
