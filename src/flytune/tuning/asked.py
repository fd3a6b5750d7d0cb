"""The requirement that a user asks for, in the units of the command line; what cannot be meant is refused."""

import math
from collections.abc import Mapping, Sequence

from flytune.errors import BadInput
from flytune.evaluation.metrics import POSITION_BAND, YAW_BAND
from flytune.tuning.requirement import AXES, AxisLimits, Requirement

LONGEST = 60.0  # s
PerAxis = float | Mapping[str, float]  # one number for all axes, or axis -> number, "" for all others
OVERSHOOT, ERROR, YAW_ERROR, PERCENTILE = 5.0, 0.01, 1.0, 50.0  # where nothing else is asked for


def make_requirement(
    settling_time: float,
    overshoot: PerAxis = OVERSHOOT,
    error: PerAxis | None = None,
    *,
    at_most: bool = False,
    tolerance: float = 10.0,
    axis: str | Sequence[str] = "position",
    percentile: PerAxis = PERCENTILE,
) -> Requirement:
    """The requirement in the units of the judge, from numbers in the units of the command line.

    Args:
        settling_time: wanted settling time in s of the first axis; the others settle no later.
        overshoot: largest allowed median overshoot in percent of the step; or axis -> percent.
        error: largest allowed median steady-state error in m, in deg for yaw; or axis -> error. 0.01 m and 1 deg where
            None. One number is that of the first axis, and of all axes with the same unit.
        at_most: the settling time is an upper bound, not a target.
        tolerance: allowed deviation from the settling time in percent.
        axis: position, x, y, z or yaw; or several of them, the leading one first.
        percentile: percentile of the trials at which the settling time is taken; or axis -> percentile.

    Raises:
        BadInput: a number is out of range, or seems to be in another unit, or is of an axis that is not asked for.
    """
    axes = [axis] if isinstance(axis, str) else list(axis)
    if not axes or not set(axes) <= set(AXES) or len(set(axes)) < len(axes):
        wrong = next((repr(each) for each in axes if each not in AXES), ", ".join(axes) or "none")
        raise BadInput(f"axis: {wrong} is not allowed. Allowed: {', '.join(AXES)}, each once.")
    hint = f" Did you mean {settling_time / 1000:g} (seconds, not milliseconds)?" if settling_time >= 200 else ""
    _check("settling-time", settling_time, 0.2, LONGEST, "s", hint)
    _check("tolerance", tolerance, 2.0, 50.0, "%", _percent_hint(tolerance))
    for name, given in (("overshoot", overshoot), ("error", error), ("percentile", percentile)):
        for each in given if isinstance(given, Mapping) else ():
            if each and each not in axes:
                raise BadInput(f"{name}: {each!r} is not asked for. Allowed: {', '.join(axes)}; add it with --axis.")
    first, *others = (_limits(each, axes[0], overshoot, error, percentile) for each in axes)
    return Requirement(
        **vars(first),
        settling_time=float(settling_time),
        tolerance=tolerance / 100,
        at_most=at_most,
        others=tuple(others),
    )


def _limits(axis: str, leading: str, overshoot: PerAxis, error: PerAxis | None, percentile: PerAxis) -> AxisLimits:
    """The limits of one axis."""
    most = _of(overshoot, axis, OVERSHOOT)
    if 0 < most < 0.5:
        raise BadInput(
            f"overshoot: {most:g} is not allowed. Allowed: 0, or 0.5 to 100 %. "
            f"Did you mean {100 * most:g} (percent of the step, not a fraction)?"
        )
    _check("overshoot", most, 0.0, 100.0, "%")
    share = _of(percentile, axis, PERCENTILE)
    _check("percentile", share, 1.0, 99.0, "%", _percent_hint(share))
    yaw = axis == "yaw"
    if not isinstance(error, Mapping):
        error = {leading: error} if error is not None and yaw != (leading == "yaw") else error
    usual = YAW_ERROR if yaw else ERROR
    deviation = usual if error is None else _of(error, axis, usual)
    band = math.degrees(YAW_BAND) if yaw else POSITION_BAND
    unit, smallest, largest = ("deg", 0.02, round(band, 9)) if yaw else ("m", 0.0002, band)
    hint = f" Did you mean {deviation / 1000:g} (metres, not millimetres)?" if not yaw and 1 <= deviation <= 20 else ""
    if deviation > largest:
        hint = hint or f" Beyond {largest:g} {unit} a trial does not count as settled."
    _check("error", deviation, smallest, largest, unit, hint)
    return AxisLimits(
        axis=axis,
        overshoot=most / 100,
        error=math.radians(deviation) if yaw else float(deviation),
        percentile=float(share),
    )


def _of(given: PerAxis, axis: str, default: float) -> float:
    """The number that is given for an axis."""
    return given.get(axis, given.get("", default)) if isinstance(given, Mapping) else given


def _percent_hint(value: float) -> str:
    return f" Did you mean {100 * value:g}?" if 0 < value < 1 else ""


def _check(name: str, value: float, smallest: float, largest: float, unit: str, hint: str = "") -> None:
    if not (math.isfinite(value) and smallest <= value <= largest):
        raise BadInput(f"{name}: {value:g} is not allowed. Allowed: {smallest:g} to {largest:g} {unit}.{hint}")
