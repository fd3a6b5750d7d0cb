"""A policy whose dials are turned in flight, at given times."""

import itertools
import math
from collections.abc import Mapping
from typing import Any, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from flytune.config.pytree import pytree, static
from flytune.errors import BadInput
from flytune.physics.dynamics import CONTROL_PERIOD
from flytune.task.dial import Dial, Setting, as_number, checked_setting
from flytune.task.task import Task

Schedule = Mapping[str, Any]  # dial -> its value; or [[time in s, value], ...], the first at 0


@runtime_checkable
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
    """A policy that turns its dials by a schedule, no faster than `Dial.sweep_time` allows.

    Its memory is the number of steps since the start, and the share of its range at which each dial stands.
    """

    policy: Dialled
    times: dict[str, Float[Array, "_"]]  # dial -> the time in s from which each of its values holds
    shares: dict[str, Float[Array, "_"]]  # of the range, for each value
    control_period: float = static(default=CONTROL_PERIOD)  # s

    @property
    def dials(self) -> dict[str, Dial]:
        """The dials of the policy."""
        return self.policy.dials

    @property
    def setting(self) -> dict[str, Any]:
        """The value of each dial; of a dial that is turned, its pairs [time in s, value]."""
        setting: dict[str, Any] = {name: float(value) for name, value in self.policy.setting.items()}
        for name, shares in self.shares.items():
            times = (float(f"{float(time):.6g}") for time in self.times[name])
            values = (float(f"{float(self.dials[name].at(share)):.6g}") for share in shares)
            setting[name] = [list(pair) for pair in zip(times, values, strict=True)]
        return setting

    def initial_memory(self) -> Any:
        """No step yet; all dials at the first value of their schedule."""
        return jnp.zeros((), jnp.int32), {name: shares[0] for name, shares in self.shares.items()}

    def act(self, memory: Any, observation: Float[Array, "17"]) -> tuple[Any, Float[Array, "4"]]:
        """The memory, and the action of one observation at the setting of this step."""
        step, now = memory
        moved = {name: self._moved(name, step, share) for name, share in now.items()}
        setting = {**self.policy.setting, **{name: self.dials[name].at(share) for name, share in moved.items()}}
        return (step + 1, moved), self.policy(observation, setting)

    def settings(self, steps: int) -> dict[str, Float[np.ndarray, "steps"]]:
        """The value of every dial at each of the first control steps."""

        def one(now: Any, step: Any) -> Any:
            moved = {name: self._moved(name, step, share) for name, share in now.items()}
            return moved, {name: self.dials[name].at(share) for name, share in moved.items()}

        values = jax.lax.scan(one, self.initial_memory()[1], jnp.arange(steps))[1]
        constant = {name: np.full(steps, float(value)) for name, value in self.policy.setting.items()}
        return constant | {name: np.asarray(value, float) for name, value in values.items()}

    def _moved(self, name: str, step: Any, share: Any) -> Any:
        """The share of the range at which a dial stands in this step, from that of the step before."""
        period = self.control_period
        wanted = self.shares[name][jnp.sum(self.times[name] < (step + 0.5) * period) - 1]
        sweep_time = self.dials[name].sweep_time
        fastest = jnp.where(sweep_time > 0, period / jnp.maximum(sweep_time, period), 1.0)
        return share + jnp.clip(wanted - share, -fastest, fastest)


def with_schedule(policy: Dialled, schedule: Schedule) -> Any:
    """The policy at a setting, or with its dials turned at given times.

    Args:
        policy: with dials.
        schedule: dial -> its value; or pairs [time in s, value], the first at 0 s, in the order of time. From each time
            on the dial moves to the value, and stays there until the next time.

    Raises:
        BadInput: an unknown dial, a value out of range, or times that are not in order.
    """
    fixed = {name: value for name, value in schedule.items() if not isinstance(value, list | tuple)}
    policy = policy.at(fixed)
    times, shares = {}, {}
    for name in schedule.keys() - fixed.keys():
        pairs = [_pair(name, each) for each in schedule[name]]
        steps = [round(time / CONTROL_PERIOD) for time, _ in pairs]
        if not pairs or steps[0] != 0 or any(later <= earlier for earlier, later in itertools.pairwise(steps)):
            raise BadInput(
                f"dial: {name}={schedule[name]} is not allowed. Allowed: [[0, value], [time in s, value], ...], with "
                "rising times."
            )
        times[name] = jnp.asarray([float(time) for time, _ in pairs])
        values = [checked_setting(policy.dials, {name: value})[name] for _, value in pairs]
        shares[name] = jnp.asarray([policy.dials[name].share(value) for value in values])
    return ScheduledPolicy(policy=policy, times=times, shares=shares) if shares else policy


def settings_along(controller: Any, task: Task, steps: int) -> dict[str, Float[np.ndarray, "steps"]]:
    """The value of each dial of a task at the first control steps of a flight.

    A dial that the controller has is set as the controller says; any other is at its default.
    """
    own: Mapping[str, Any] = {}
    if isinstance(controller, ScheduledPolicy):
        own = controller.settings(steps)
    elif getattr(controller, "dials", {}):
        own = controller.setting
    return {name: np.full(steps, own.get(name, dial.default), float) for name, dial in task.dial.items()}


def shown_setting(controller: Any) -> dict[str, Any]:
    """The setting of a controller's dials in plain numbers of six digits, see `Schedule`; empty for one without."""
    setting = controller.setting if getattr(controller, "dials", {}) else {}
    return {name: value if isinstance(value, list) else float(f"{float(value):.6g}") for name, value in setting.items()}


def _pair(name: str, given: Any) -> tuple[float, float]:
    time, value = map(as_number, given) if isinstance(given, list | tuple) and len(given) == 2 else (None, None)
    if time is None or value is None or not (math.isfinite(time) and math.isfinite(value)):
        raise BadInput(f"dial: {name}: {given} is not allowed. Allowed: a pair [time in s, value].")
    return time, value
