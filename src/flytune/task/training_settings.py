"""Trainer settings: how a task is learned. They are part of the task, so that one file holds all (paper R16 to R18)."""

import dataclasses
import math
from typing import Annotated, Any, Protocol, runtime_checkable

from annotated_types import Ge, Gt, Le, Lt, Unit, doc

from flytune.config.document import Real, Whole
from flytune.config.pytree import pytree
from flytune.task.initial_state import InitialState
from flytune.task.observation import RATE

Share = Annotated[Real, Ge(0), Le(1), Unit("1")]
Positive = Annotated[Real, Gt(0), Unit("1")]
Count = Annotated[Whole, Ge(1), Le(1_000_000)]
Layer = Annotated[Whole, Ge(1), Le(4096)]
MOST_SAMPLES = 2**26  # of an update; each takes some 200 bytes


@runtime_checkable
class TrainerSettings(Protocol):
    """The part of the settings that is the same for every trainer."""

    @property
    def hidden(self) -> tuple[int, ...]:
        """The sizes of the hidden layers of the actor."""
        ...

    @property
    def updates(self) -> int:
        """The number of updates of a training."""
        ...

    @property
    def steps_per_update(self) -> int:
        """The number of environment steps of one update."""
        ...

    def with_steps(self, steps: int) -> "TrainerSettings":
        """The settings of a training of `steps` environment steps, rounded up to whole updates."""
        ...

    def at_rate(self, rate: int) -> "TrainerSettings":
        """The settings at a control rate in Hz: what is given for steps of 0.01 s, for control steps."""
        ...

    def tuned(self, *, slow: bool, warm_start: bool) -> dict[str, tuple[Any, str]]:
        """The settings that a tuning changes by itself: name -> value and reason.

        Args:
            slow: the wanted response is slow.
            warm_start: the training starts from a policy that flies.
        """
        ...


def _problem_of_samples(name: str, environments: int, steps: int, fewest: int = 2) -> str | None:
    """What makes the number of samples of an update impossible, or None."""
    samples = environments * steps
    if fewest <= samples <= MOST_SAMPLES:
        return None
    return (
        f"{name}: {steps} steps of {environments} environments are {samples} samples per update. "
        f"Allowed: {fewest} to {MOST_SAMPLES}."
    )


def _divisor(number: int, near: float) -> int:
    """The divisor of a number that is nearest to a value, 2 or more."""
    divisors = (each for each in range(2, number + 1) if number % each == 0)
    return min(divisors, key=lambda each: abs(math.log(each / near)))


@pytree
class PpoSettings:
    """Proximal policy optimisation (Schulman et al. 2017), by default the paper's (R16 to R18)."""

    steps: Annotated[Whole, Ge(1), Unit("environment steps of 0.01 s")] = 6_000_000  # R18
    environments: Count = 128  # reading of R18: 128 x 128 gives the samples of 4 x 4096
    rollout: Annotated[Whole, Ge(1), Le(1_000_000), Unit("steps of 0.01 s per environment")] = 128
    epochs: Count = 12  # R17
    minibatch: Annotated[Whole, Ge(2), Unit("samples"), doc("advantages are normalised in each")] = 128  # R17
    learning_rate: Annotated[Real, Gt(0), Unit("1")] = 2e-4  # R17
    clip_range: Annotated[Real, Gt(0), Unit("1")] = 0.15  # R17
    discount: Annotated[Real, Ge(0), Le(1), Unit("per 0.01 s")] = 0.99  # R17: Stable-Baselines3
    gae_lambda: Annotated[Real, Ge(0), Le(1), Unit("per 0.01 s")] = 0.95
    value_weight: Annotated[Real, Ge(0), Unit("1")] = 0.5
    entropy_weight: Annotated[Real, Ge(0), Unit("1")] = 0.0
    max_grad_norm: Annotated[Real, Gt(0), Unit("1")] = 0.5
    separate_grad_clipping: bool = False  # max_grad_norm applies to the gradients of actor and critic separately
    final_learning_rate: Share = 1.0  # as a share of the first, reached linearly
    input_scale: tuple[Positive, Positive, Positive, Positive, Positive] = (1.0, 1.0, 1.0, 1.0, 1.0)  # per block of R7
    initial_log_std: Annotated[Real, Ge(-20), Le(5), Unit("1")] = 0.0
    hidden: tuple[Layer, ...] = (64, 64)  # R16
    ema_decay: Annotated[Real, Ge(0), Lt(1), Unit("1 per update")] = 0.95  # share of the old weights in the flown ones

    def problem(self) -> str | None:
        """What makes the numbers impossible together, or None."""
        samples = self.environments * self.rollout
        if text := _problem_of_samples("rollout", self.environments, self.rollout):
            return text
        if samples % self.minibatch:
            return (
                f"minibatch: {self.minibatch} does not divide environments * rollout = {samples}. Allowed: a divisor."
            )
        return None

    @property
    def updates(self) -> int:
        """The number of updates of a training."""
        return math.ceil(self.steps / self.steps_per_update)

    @property
    def steps_per_update(self) -> int:
        """The number of environment steps of one update."""
        return self.environments * self.rollout

    def with_steps(self, steps: int) -> "PpoSettings":
        """The settings of a training of `steps` environment steps, rounded up to whole updates."""
        return dataclasses.replace(self, steps=steps)

    def at_rate(self, rate: int) -> "PpoSettings":
        """The settings at a control rate in Hz, with as many minibatches as at 100 Hz and the same time constants."""
        if rate == RATE:
            return self
        factor = rate / RATE
        return dataclasses.replace(
            self,
            steps=math.ceil(self.steps * factor),
            rollout=(rollout := math.ceil(self.rollout * factor)),
            minibatch=_divisor(rollout * self.environments, self.minibatch * factor),
            discount=self.discount ** (1 / factor),
            gae_lambda=self.gae_lambda ** (1 / factor),
        )

    def tuned(self, *, slow: bool, warm_start: bool) -> dict[str, tuple[Any, str]]:
        """The settings that a tuning changes by itself: none."""
        return {}


@pytree
class ApgSettings:
    """Analytic policy gradient: gradient ascent on the reward, through the simulator (our own; not in the paper).

    It has its own initial states, which are wider than those of the task. A policy learns to keep the speed bound from
    2 m away only if it is trained there.
    """

    initial_state: InitialState = InitialState(
        lowest_position=(-2.0, -2.0, 0.1),
        highest_position=(2.0, 2.0, 2.0),
        largest_tilt=0.27,
        largest_yaw=math.pi,
    )
    updates: Count = 200
    environments: Count = 64
    window: Annotated[Whole, Ge(1), Le(1_000_000), Unit("steps of 0.01 s")] = 250  # of each episode in one gradient
    learning_rate: Annotated[Real, Gt(0), Unit("1")] = 5e-3  # of the biases, by Adam
    muon_factor: Annotated[Real, Ge(0), Unit("1")] = 16.0  # by Muon, the weights learn at this multiple; 0: by Adam too
    final_learning_rate: Share = 0.02  # as a share of the first, reached by a cosine
    adam_b1: Annotated[Real, Ge(0), Lt(1), Unit("1")] = 0.7  # Adam's b1
    adam_b2: Annotated[Real, Ge(0), Lt(1), Unit("1")] = 0.95  # Adam's b2
    max_grad_norm: Annotated[Real, Gt(0), Unit("1")] = 1.0
    barrier_weight: Annotated[Real, Ge(0), Unit("1")] = 45.0
    barrier_margin: Annotated[Real, Ge(0), Lt(1), Unit("1")] = 0.1  # the barrier begins below this margin
    barrier_knee: Annotated[Real, Ge(0), Unit("1")] = 0.0  # deeper below it by more, the barrier is linear; 0: nowhere
    termination_slack: Annotated[Real, Ge(0), Unit("1")] = 0.0  # share of a bound; beyond it by more, an episode ends
    input_scale: tuple[Positive, Positive, Positive, Positive, Positive] = (2.0, 3.0, 2.0, 0.3, 1.0)  # per block of R7
    hidden: tuple[Layer, ...] = (64, 64)
    ema_decay: Annotated[Real, Ge(0), Lt(1), Unit("1 per update")] = 0.95

    def problem(self) -> str | None:
        """What makes the numbers impossible together, or None."""
        return _problem_of_samples("window", self.environments, self.window, fewest=1)

    @property
    def steps_per_update(self) -> int:
        """The number of environment steps of one update."""
        return self.environments * self.window

    def with_steps(self, steps: int) -> "ApgSettings":
        """The settings of a training of `steps` environment steps, rounded up to whole updates."""
        return dataclasses.replace(self, updates=math.ceil(steps / self.steps_per_update))

    def at_rate(self, rate: int) -> "ApgSettings":
        """The settings at a control rate in Hz, with windows of the same time."""
        return self if rate == RATE else dataclasses.replace(self, window=math.ceil(self.window * rate / RATE))

    def tuned(self, *, slow: bool, warm_start: bool) -> dict[str, tuple[Any, str]]:
        """The settings that a tuning changes by itself, see `TrainerSettings`."""
        changes: dict[str, tuple[Any, str]] = {
            "termination_slack": (max(0.5, float(self.termination_slack)), "tuned: as the refined presets")
        }
        if slow:
            changes["window"] = (max(500, self.window), "tuned: a slow response is seen whole")
        if warm_start:
            changes["updates"] = (200, "tuned: it starts from a policy that flies")
            changes["learning_rate"] = (0.002, "tuned: it starts from a policy that flies")
        return changes
