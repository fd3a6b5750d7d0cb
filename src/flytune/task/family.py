"""Families of tasks, in which some numbers of the task or the vehicle change from episode to episode."""

from typing import Any, Protocol, runtime_checkable

import jax

from flytune.task.task import Task


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
