"""A policy whose dials are turned in flight, at given times."""

import itertools
from collections.abc import Mapping
from typing import Any, Protocol

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from flytune.config.pytree import pytree
from flytune.errors import BadInput
from flytune.physics.dynamics import CONTROL_PERIOD
from flytune.task.dial import Dial, Setting, checked_setting

Schedule = Mapping[str, Any]  # dial -> its value; or [[time in s, value], ...], the first at 0


class Dialled(Protocol):
    """A controller with dials: a `Policy`, or one that runs the file of another program."""

    @property
    def dials(self) -> dict[str, Dial]:
        """Its dials."""
        ...

    @property
    def setting(self) -> dict[str, Any]:
        """The value of each."""
        ...

    def at(self, setting: Setting | None = None, /) -> Any:
        """The controller at another setting."""
        ...

    def __call__(self, observation: Float[Array, "17"], setting: Setting | None = None) -> Float[Array, "4"]:
        """The action for one observation, at a setting."""
        ...


@pytree
class ScheduledPolicy:
    """A policy that sets its dials by a schedule; its memory is the number of steps since the start."""

    policy: Dialled
    first_steps: dict[str, Int[Array, "_"]]  # dial -> the control step from which each of its values holds
    values: dict[str, Float[Array, "_"]]

    @property
    def dials(self) -> dict[str, Dial]:
        """The dials of the policy."""
        return self.policy.dials

    def settings(self) -> list[tuple[int, dict[str, float]]]:
        """Each setting, and the control step from which it holds, in the order of time."""
        changes = sorted({0, *(int(step) for steps in self.first_steps.values() for step in steps)})
        return [(step, {name: float(value) for name, value in self._at(step).items()}) for step in changes]

    def initial_memory(self) -> Int[Array, ""]:
        """No step yet."""
        return jnp.zeros((), jnp.int32)

    def act(self, memory: Any, observation: Float[Array, "17"]) -> tuple[Any, Float[Array, "4"]]:
        """The number of steps, and the action of one observation at the setting of this step."""
        return memory + 1, self.policy(observation, self._at(memory))

    def _at(self, step: Any) -> dict[str, Any]:
        setting = dict(self.policy.setting)
        for name, first_steps in self.first_steps.items():
            setting[name] = self.values[name][jnp.sum(first_steps <= step) - 1]
        return setting


def with_schedule(policy: Dialled, schedule: Schedule) -> Any:
    """The policy at a setting, or with its dials turned at given times.

    Args:
        policy: with dials.
        schedule: dial -> its value; or pairs [time in s, value], the first at 0 s, in the order of time. A value holds
            until the next one.

    Raises:
        BadInput: an unknown dial, a value out of range, or times that are not in order.
    """
    fixed = {name: value for name, value in schedule.items() if not isinstance(value, list | tuple)}
    policy = policy.at(fixed)
    first_steps, values = {}, {}
    for name in schedule.keys() - fixed.keys():
        pairs = [_pair(name, each) for each in schedule[name]]
        steps = [round(time / CONTROL_PERIOD) for time, _ in pairs]
        if not pairs or steps[0] != 0 or any(later <= earlier for earlier, later in itertools.pairwise(steps)):
            raise BadInput(
                f"dial: {name}={schedule[name]} is not allowed. Allowed: [[0, value], [time in s, value], ...], with "
                "rising times."
            )
        first_steps[name] = jnp.asarray(steps, jnp.int32)
        values[name] = jnp.asarray([checked_setting(policy.dials, {name: value})[name] for _, value in pairs])
    return ScheduledPolicy(policy=policy, first_steps=first_steps, values=values) if values else policy


def _pair(name: str, given: Any) -> tuple[float, float]:
    numbers = np.asarray(given, object)
    if numbers.shape != (2,) or not all(isinstance(x, int | float) and np.isfinite(x) for x in numbers):
        raise BadInput(f"dial: {name}: {given} is not allowed. Allowed: a pair [time in s, value].")
    return float(numbers[0]), float(numbers[1])
