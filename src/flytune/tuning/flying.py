"""The flights of a tuning."""

from typing import Any

import jax.numpy as jnp

from flytune.config.pytree import pytree
from flytune.control.policy import Policy
from flytune.evaluation.flights import Flights
from flytune.evaluation.fly import fly
from flytune.evaluation.judge import Judgement, judge
from flytune.task.task import Task
from flytune.tuning.requirement import Requirement


@pytree
class HoverThrust:
    """A controller that asks for hover speed at all times; it serves to draw initial conditions."""

    def initial_memory(self) -> tuple[()]:
        """None."""
        return ()

    def act(self, memory: Any, observation: Any) -> Any:
        """The action 0."""
        return memory, jnp.zeros(4)


def hover_flights(task: Task, seed: int, trials: int) -> Flights:
    """Short flights without a controller, of which only the initial conditions count."""
    return fly(HoverThrust(), task, trials=trials, seed=seed, duration=0.6)


def flights_for(requirement: Requirement, policy: Policy, task: Task, seed: int, trials: int) -> Flights:
    """The flights of a policy on trials that are long enough for the requirement."""
    return fly(policy, task, trials=trials, seed=seed, duration=requirement.trial_duration())


def fly_for(requirement: Requirement, policy: Policy, task: Task, seed: int, trials: int) -> Judgement:
    """The judgement of these flights."""
    return judge(flights_for(requirement, policy, task, seed, trials))
