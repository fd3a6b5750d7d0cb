"""Reward terms, one small class per term (paper R10).

To add a term: write a class with a `kind`, annotated numbers and `__call__(situation)`, and name it in `RewardTerm`.
"""

from typing import Annotated, Literal

import jax.numpy as jnp
from annotated_types import Ge, Le, Unit
from jaxtyping import Array, Float
from pydantic import Field

from flytune.config.document import Real
from flytune.config.pytree import pytree, static
from flytune.physics import rotation
from flytune.physics.components import squared_norm
from flytune.task.situation import Situation

Error = Literal["horizontal", "vertical", "position", "velocity", "attitude", "body_rate"]


def squared_error(situation: Situation, of: Error) -> Float[Array, ""]:
    """The square of the error a term looks at, from the target and its motion: m^2, (m/s)^2, rad^2 or (rad/s)^2.

    The exponentials need squares, and a square root has no gradient at the target.
    """
    match of:
        case "horizontal":
            return squared_norm(situation.position_error[:2])
        case "vertical":
            return situation.position_error[2] ** 2
        case "position":
            return squared_norm(situation.position_error)
        case "velocity":
            return squared_norm(situation.velocity_error)
        case "attitude":
            return rotation.angle(situation.attitude_error) ** 2
        case "body_rate":
            return squared_norm(situation.body_rate_error)


@pytree
class Survival:
    """The same reward for every step that is survived; more makes the controller bolder (H1, H2).

    Source: paper R10, s; 0.05 in R11 and R12, 0.01 in R13.
    """

    kind: Literal["survival"] = static(default="survival")
    reward: Annotated[Real, Unit("1")]

    def __call__(self, situation: Situation) -> Float[Array, ""]:
        """The constant."""
        return jnp.asarray(self.reward, float)


@pytree
class Exponential:
    """Bounded reward for a small error: weight * exp(-sharpness * e^2), in [0, weight].

    Its gradient is largest at e = 1 / sqrt(2 sharpness): a sharper term is more accurate and reaches less far (H3).

    Source: paper R10.
    """

    kind: Literal["exponential"] = static(default="exponential")
    of: Error = static()
    weight: Annotated[Real, Ge(0), Unit("1")]
    sharpness: Annotated[Real, Ge(0), Unit("1/unit(e)^2")]

    def __call__(self, situation: Situation) -> Float[Array, ""]:
        """Reward of one situation, in [0, weight]."""
        return self.weight * jnp.exp(-self.sharpness * squared_error(situation, self.of))


@pytree
class DualExponential:
    """Bounded reward for a small error, wide for reach and narrow for accuracy (H4, H5).

        reward(e) = weight * (share * exp(-wide * e^2) + (1 - share) * exp(-narrow * e^2))

    `wide` decides from how far away the reward grows towards the target; `narrow`, how accurately the target is held.

    Source: paper R10, alpha = weight * share, beta = weight * (1 - share).
    """

    kind: Literal["dual_exponential"] = static(default="dual_exponential")
    of: Error = static()
    weight: Annotated[Real, Ge(0), Unit("1")]
    share: Annotated[Real, Ge(0), Le(1), Unit("1")]
    wide: Annotated[Real, Ge(0), Unit("1/unit(e)^2")]
    narrow: Annotated[Real, Ge(0), Unit("1/unit(e)^2")]

    def __call__(self, situation: Situation) -> Float[Array, ""]:
        """Reward of one situation, in [0, weight]."""
        squared = squared_error(situation, self.of)
        reach = self.share * jnp.exp(-self.wide * squared)
        accuracy = (1 - self.share) * jnp.exp(-self.narrow * squared)
        return self.weight * (reach + accuracy)

    def problem(self) -> str | None:
        """What makes the numbers impossible together, or None."""
        if self.narrow < self.wide:
            return f"narrow: {self.narrow} is wider than `wide`. Allowed: {self.wide} (the value of wide) or more."
        return None


@pytree
class Smoothness:
    """Penalty on changes of the action: -weight * |a_t - a_{t-1}|^2 (H8, H9).

    Source: paper R10, l5.
    """

    kind: Literal["smoothness"] = static(default="smoothness")
    weight: Annotated[Real, Ge(0), Unit("1")]

    def __call__(self, situation: Situation) -> Float[Array, ""]:
        """Reward of one situation, at most zero."""
        return -self.weight * squared_norm(situation.action_change)


RewardTerm = Annotated[Survival | Exponential | DualExponential | Smoothness, Field(discriminator="kind")]


def rewards(terms: dict[str, RewardTerm], situation: Situation) -> dict[str, Float[Array, ""]]:
    """The reward of each term by its name; their sum is the reward of the step."""
    return {name: term(situation) for name, term in terms.items()}
