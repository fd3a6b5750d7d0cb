"""The target of a task: a point, or a path that it moves along."""

from collections.abc import Mapping
from typing import Annotated, Any, Literal

import numpy as np
from jaxtyping import Float
from pydantic import BeforeValidator, Field

from flytune.config.fields import annotations
from flytune.config.pytree import pytree, static
from flytune.task.paths import Circle, Helix, Lemniscate, Metres, Yaw
from flytune.task.reference import Reference
from flytune.task.waypoints import Waypoints


@pytree
class Point:
    """Where to hover: a position and a heading, level and at rest (paper R19: (0, 0, 1) m, zero attitude)."""

    kind: Literal["point"] = static(default="point")
    position: tuple[Metres, Metres, Metres]
    yaw: Yaw

    @property
    def first_yaw(self) -> Any:
        """The yaw in rad."""
        return self.yaw

    def reference(self) -> Reference:
        """The reference, the same at any time."""
        return Reference(position=self.position, yaw=self.yaw)


KINDS = (Point, Waypoints, Circle, Lemniscate, Helix)


def _with_kind(given: Any) -> Any:
    """The table with its kind; without one it is a point, as in all files of version 0.1."""
    return {"kind": "point", **given} if isinstance(given, Mapping) else given


Target = Annotated[
    Point | Waypoints | Circle | Lemniscate | Helix, Field(discriminator="kind"), BeforeValidator(_with_kind)
]


def sampled(target: Any, time: Float[np.ndarray, "K"]) -> tuple[np.ndarray, Any]:
    """Position in m and yaw in rad of a target: [3] and a number; of one that moves [K, 3] and [K] at times in s."""
    if isinstance(target, Point):
        return np.asarray(target.position), float(target.yaw)
    place = np.stack([np.broadcast_to(part, time.shape) for part in target.place(time, np)], axis=-1)
    return place, np.broadcast_to(target.heading(time, np), time.shape).copy()


def target_at(target: Any, time: float) -> Point:
    """Where a target is at a time in s."""
    if isinstance(target, Point):
        return target
    place, yaw = sampled(target, np.array([time]))
    x, y, z = map(float, place[0])
    return Point(position=(x, y, z), yaw=float(yaw[0]))


def of_kind(table: Mapping[str, Any], kind: str) -> dict[str, Any]:
    """The table of a target with another kind, without what that kind does not have; a point becomes its centre."""
    here = table.get("position", table.get("centre"))
    both = {**table, "kind": kind} | ({"position": here, "centre": here} if here is not None else {})
    known = next((cls for cls in KINDS if annotations(cls)["kind"].__args__[0] == kind), None)
    kept = ("kind", "yaw", "file") if kind == "csv" else annotations(known) if known else both
    return {key: value for key, value in both.items() if key in kept}
