"""The protocol every controller keeps, learned or classical."""

from typing import Any, Protocol, runtime_checkable

from jaxtyping import Array, Float


@runtime_checkable
class Controller(Protocol):
    """A controller: a JAX pytree that turns observations into actions, and may remember something in between."""

    def initial_memory(self) -> Any:
        """What the controller knows before its first observation, a pytree; () for one that remembers nothing."""
        ...

    def act(self, memory: Any, observation: Float[Array, "17"]) -> tuple[Any, Float[Array, "4"]]:
        """The memory after, and the action in [-1, 1]^4, of one noisy observation (paper R7, R9)."""
        ...
