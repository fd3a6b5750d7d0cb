"""Termination conditions: each says how far the state is from ending the episode (paper R14).

A condition returns a margin, the share of its bound that is left: positive inside, zero at the bound, negative beyond.
Training, barriers, evaluation and plots all read the same margins.

To add a condition: write a subclass of `Bounded` with a `kind`, a bound and `measure(situation)`, and name it in
`Termination`.
"""

import math
from typing import Annotated, Any, ClassVar, Literal

import jax.numpy as jnp
from annotated_types import Ge, Gt, Le, Unit, doc
from jaxtyping import Array, Float, Int
from pydantic import Field

from flytune.config.document import Real
from flytune.config.pytree import pytree, static
from flytune.physics import rotation
from flytune.task.situation import Situation

SAFE = -1  # cause of an episode that goes on


@pytree
class Bounded:
    """What every condition has beside its margin.

    `quantity` is what is bounded: altitude, distance, attitude_error, tilt, speed or body_rate. `key` is the field that
    holds the bound.
    """

    quantity: ClassVar[str]
    key: ClassVar[str] = "bound"
    barrier: Annotated[Real, Ge(0), Unit("times apg.barrier_weight")] = 1.0  # of the analytic policy gradient
    slack: Annotated[Real, Ge(0), Unit("times apg.termination_slack")] = 1.0  # of the analytic policy gradient

    @property
    def limit(self) -> Any:
        """The bound in SI units: m, m/s, rad or rad/s."""
        return getattr(self, self.key)

    def measure(self, situation: Situation) -> Float[Array, ""]:
        """What is bounded, in the unit of the limit."""
        raise NotImplementedError

    def margin(self, situation: Situation) -> Float[Array, ""]:
        """Share of the bound that is left: 1 - measure / limit."""
        return 1 - self.measure(situation) / self.limit


@pytree
class MinimumAltitude(Bounded):
    """Ends an episode that sinks below `bound`, which may be the ground, 0, or below it. Source: paper R14, 0.1 m."""

    quantity = "altitude"
    kind: Literal["minimum_altitude"] = static(default="minimum_altitude")
    bound: Annotated[Real, Ge(-1000), Le(1000), Unit("m")]

    def measure(self, situation: Situation) -> Float[Array, ""]:
        """The altitude."""
        return situation.altitude

    def margin(self, situation: Situation) -> Float[Array, ""]:
        """(z - bound) / bound: zero at the bound, one at twice its height; of a bound of 0 or below, z - bound in m."""
        above = jnp.asarray(self.limit) > 0
        return jnp.where(
            above, situation.altitude / jnp.where(above, self.limit, 1.0) - 1, situation.altitude - self.limit
        )


@pytree
class MaximumDistance(Bounded):
    """Ends an episode that strays from its target (H11). Source: paper R14, 3.0 m."""

    quantity = "distance"
    kind: Literal["maximum_distance"] = static(default="maximum_distance")
    bound: Annotated[Real, Gt(0), Unit("m")]

    def measure(self, situation: Situation) -> Float[Array, ""]:
        """The distance to the target."""
        return rotation.safe_norm(situation.position_error)


@pytree
class MaximumAttitudeError(Bounded):
    """Ends an episode whose geodesic attitude error is too large (H11).

    Source: paper R14, pi: never true of an angle in [0, pi], and kept because it is printed (C9).
    """

    quantity = "attitude_error"
    kind: Literal["maximum_attitude_error"] = static(default="maximum_attitude_error")
    bound: Annotated[Real, Gt(0), Le(math.pi), Unit("rad")]

    def measure(self, situation: Situation) -> Float[Array, ""]:
        """The angle to the target's attitude."""
        return rotation.angle(situation.attitude_error)


@pytree
class MaximumTilt(Bounded):
    """Ends an episode that rolls or pitches too far, in place of the geodesic bound (H10). Source: paper R14."""

    quantity, key = "tilt", "bound_deg"
    kind: Literal["maximum_tilt"] = static(default="maximum_tilt")
    bound_deg: Annotated[Real, Gt(0), Le(180), Unit("deg")]

    @property
    def limit(self) -> Any:
        """The bound in rad."""
        return self.bound_deg * math.pi / 180

    def measure(self, situation: Situation) -> Float[Array, ""]:
        """The larger of |roll| and |pitch|."""
        return jnp.maximum(jnp.abs(situation.roll), jnp.abs(situation.pitch))


@pytree
class MaximumSpeed(Bounded):
    """Ends an episode that flies too fast; the strongest parameter on settling time (H7).

    Source: paper R14: 0.8 m/s baseline, 1.0 acrobatic, 0.2 inspection.
    """

    quantity = "speed"
    kind: Literal["maximum_speed"] = static(default="maximum_speed")
    bound: Annotated[Real, Gt(0), Unit("m/s")]

    def measure(self, situation: Situation) -> Float[Array, ""]:
        """The speed."""
        return rotation.safe_norm(situation.velocity)


@pytree
class MaximumBodyRate(Bounded):
    """Ends an episode that turns too fast (H8, H9). Reading: the norm of the rate, in deg/s.

    Source: paper R14: 530 deg/s baseline and acrobatic, 115 inspection.
    """

    quantity, key = "body_rate", "bound_deg_per_s"
    kind: Literal["maximum_body_rate"] = static(default="maximum_body_rate")
    bound_deg_per_s: Annotated[Real, Ge(20), Unit("deg/s"), doc("a slower vehicle cannot right itself")]

    @property
    def limit(self) -> Any:
        """The bound in rad/s."""
        return self.bound_deg_per_s * math.pi / 180

    def measure(self, situation: Situation) -> Float[Array, ""]:
        """The norm of the body rate."""
        return rotation.safe_norm(situation.body_rate)


Termination = Annotated[
    MinimumAltitude | MaximumDistance | MaximumAttitudeError | MaximumTilt | MaximumSpeed | MaximumBodyRate,
    Field(discriminator="kind"),
]


def margins(terminations: dict[str, Termination], situation: Situation) -> dict[str, Float[Array, ""]]:
    """The margin of each condition by its name."""
    return {name: condition.margin(situation) for name, condition in terminations.items()}


def causes(terminations: dict[str, Termination]) -> list[str]:
    """What each cause code stands for: the conditions in alphabetical order, then divergence."""
    return [*sorted(terminations), "diverged"]


def cause(margins: dict[str, Float[Array, ""]]) -> Int[Array, ""]:
    """Why the episode ends now, as an index into `causes`, or SAFE: the condition with the smallest negative margin.

    Margins that are not finite mean that the state is not: the code then says "diverged".
    """
    values = jnp.stack([margins[name] for name in sorted(margins)]) if margins else jnp.zeros(0)
    if not margins:
        return jnp.asarray(SAFE)
    broken = jnp.where(jnp.min(values) < 0, jnp.argmin(values), SAFE)
    return jnp.where(jnp.all(jnp.isfinite(values)), broken, len(margins))
