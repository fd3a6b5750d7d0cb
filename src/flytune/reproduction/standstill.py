"""C1: the distance from which standing still earns the largest discounted reward. NumPy only.

The horizontal distance r is all that is left of the vehicle: it moves towards the target at a speed up to its bound, at
perfect altitude and attitude. Then V(0) = R(0, 0) / (1 - discount), and for growing distance

    V(r) = max( R(r, 0) / (1 - discount),  max over v of R(r, v) + discount V(r - v dt) )

is exact on a grid whose cells the speeds are whole multiples of: every V needed on the right is nearer to the target.
"""

import numpy as np
from jaxtyping import Float

from flytune.physics.dynamics import CONTROL_PERIOD
from flytune.task.reward import DualExponential, Exponential
from flytune.task.task import Task

SPEEDS = 16  # the speed bound and its parts: 1/16, 2/16, ...
FARTHEST = 3.0  # m


def standstill_distance(task: Task, discount: float) -> float | None:
    """The horizontal distance in metres beyond which standing still earns most; None where it never does, up to 3 m.

    Args:
        task: whose reward and speed bound are meant; it needs a speed bound.
        discount: per control step, below 1.
    """
    bound = task.speed_bound
    assert bound is not None, "standing still is a matter of a speed bound"
    cell = bound * CONTROL_PERIOD / SPEEDS
    distance = np.arange(round(FARTHEST / cell)) * cell
    speed = np.arange(SPEEDS + 1) / SPEEDS * bound
    place = _term(task, "horizontal", distance)
    motion = _term(task, "velocity", speed)
    rest = (place + motion[0]) / (1 - discount)
    value = np.empty_like(distance)
    stays = np.zeros(len(distance), bool)
    value[0] = rest[0]
    for index in range(1, len(distance)):
        reach = min(SPEEDS, index)
        moving = place[index] + motion[1 : reach + 1] + discount * value[index - reach : index][::-1]
        best = moving.max()
        stays[index] = rest[index] >= best
        value[index] = max(rest[index], best)
    moves = np.flatnonzero(~stays)
    first = moves[-1] + 1 if moves.size else 0  # within a cell of the target a step gains less than it costs
    return float(distance[first]) if first < len(distance) else None


def _term(task: Task, of: str, value: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
    """The reward of the exponentials of one quantity; all other terms are equal for every choice of speed."""
    total = np.zeros_like(value)
    for term in task.reward.values():
        if isinstance(term, Exponential) and term.of == of:
            total += term.weight * np.exp(-term.sharpness * value**2)
        elif isinstance(term, DualExponential) and term.of == of:
            wide, narrow = np.exp(-term.wide * value**2), np.exp(-term.narrow * value**2)
            total += term.weight * (term.share * wide + (1 - term.share) * narrow)
    return total
