"""Flights that were logged elsewhere: `Flights` from the arrays that a log has, whatever flew."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from flytune.errors import BadInput
from flytune.evaluation.flights import COLUMNS, Flights
from flytune.evaluation.metrics import POSITION_BAND
from flytune.evaluation.resampling import LONGEST_GAP, make_grid

OPTIONAL = tuple(field for field in COLUMNS if field not in ("position", "attitude"))
LOGGED = {"task": "", "vehicle": "", "simulator": "", "seed": None, "initial_conditions": "as logged"}


def flights_from(
    time: Any,
    position: Any,
    *,
    yaw: Any = None,
    attitude: Any = None,
    target_position: Any,
    target_yaw: float = 0.0,
    velocity: Any = None,
    body_rate: Any = None,
    rotor_speed_rpm: Any = None,
    action: Any = None,
    name: str = "log",
    longest_gap: float = LONGEST_GAP,
    on_message: Callable[[str], None] = lambda line: None,
) -> Flights:
    """Flights from arrays, for `judge`; what is not given is null in the judgement.

    The flight is put on 100 Hz: numbers by linear interpolation, attitudes spherically. Rows with a NaN are left out.

    Args:
        time: [K] s, increasing, of any rate; the flight begins at its first sample.
        position: [K, 3] m, z up; or [N, K, 3] for N flights with the same instants.
        yaw: [K] or [N, K] rad about z; needed unless `attitude` is given.
        attitude: [K, 4] or [N, K, 4] unit quaternions (x, y, z, w), body to inertial.
        target_position: [3] m.
        target_yaw: rad.
        velocity: [K, 3] or [N, K, 3] m/s; without it there is no peak speed.
        body_rate: [K, 3] or [N, K, 3] rad/s, body frame.
        rotor_speed_rpm: [K, 4] or [N, K, 4] rpm.
        action: [K, 4] or [N, K, 4] in [-1, 1]; without it there are no figures of the action.
        name: of the flights in tables.
        longest_gap: s without a sample over which is interpolated; a longer gap is refused.
        on_message: called with a line on what was done to the log.

    Raises:
        BadInput: a shape, a time that decreases, a gap, a flight under 2 s, or a target that is not finite.
    """
    clock = np.asarray(time, dtype=np.float64)
    if (yaw is None) == (attitude is None):
        raise BadInput("yaw: give either yaw or attitude.")
    if attitude is None:
        angle = np.asarray(yaw, dtype=np.float64)
        fields = {"position": position, "yaw": angle[..., None]}
    else:
        fields = {"position": position, "attitude": attitude}
    given = (velocity, body_rate, rotor_speed_rpm, action)
    fields |= {field: values for field, values in zip(OPTIONAL, given, strict=True) if values is not None}
    widths = {"yaw": 1} | {field: len(names.split()) for field, (_, names) in COLUMNS.items()}
    arrays = {field: np.asarray(values, dtype=np.float64) for field, values in fields.items()}
    arrays = {field: values[None] if values.ndim == 2 else values for field, values in arrays.items()}
    trials = arrays["position"].shape[0]
    for field, values in arrays.items():
        if clock.ndim != 1 or values.shape != (trials, clock.size, widths[field]):
            raise BadInput(
                f"{field}: the shape {values.shape} is not allowed with time {clock.shape}. Allowed: "
                f"({clock.size}, {widths[field]}), or the number of flights before that."
            )
    target = np.asarray(target_position, dtype=np.float64)
    if target.shape != (3,) or not np.isfinite([*target, target_yaw]).all():
        raise BadInput(
            f"target: {target.tolist()}, yaw {target_yaw} is not allowed. Allowed: x, y, z in m, yaw in rad."
        )
    whole = []
    for number in range(trials):
        where = name if trials == 1 else f"{name}, flight {number + 1}"
        part = {field: values[number] for field, values in arrays.items()}
        whole.append(_one(where, clock, part, target, float(target_yaw), longest_gap, on_message))
    return joined(whole, name, on_message)


def joined(flights: Sequence[Flights], name: str, on_message: Callable[[str], None] = lambda line: None) -> Flights:
    """Several flights to the same target as one; they are cut to the length of the shortest, which a line says.

    Raises:
        BadInput: the targets differ.
    """
    first, *others = flights
    samples = min(one.time.size for one in flights)
    target = _target(first, samples)
    for other in others:
        there = _target(other, samples)
        if there.shape != target.shape or not np.allclose(there, target, atol=1e-6):
            shown = "" if first.moving or other.moving else f" ({target[:3].tolist()} and {there[:3].tolist()})"
            raise BadInput(
                f"target: {first.name} and {other.name} have different targets{shown}. Judge each of them alone, or "
                "give one --target."
            )
    if any(one.time.size > samples for one in flights):
        on_message(f"{name}: all flights are cut to the shortest, {flights[0].time[samples - 1]:g} s")
    missing = tuple(field for field in OPTIONAL if any(field in one.missing for one in flights))
    stacked = {field: np.concatenate([getattr(one, field)[:, :samples] for one in flights]) for field in COLUMNS}
    stacked |= {field: np.full_like(stacked[field], np.nan) for field in missing}
    crashed = np.concatenate([one.crashed for one in flights])
    common = [name for name in first.margins if all(name in other.margins for other in others)]
    margins = {name: np.concatenate([one.margins[name][:, :samples] for one in flights]) for name in common}
    time = first.time[:samples]
    if first.moving:
        stacked |= {"target_position": target[:, :3], "target_yaw": target[:, 3]}
    return dataclasses.replace(
        first, **stacked, margins=margins, time=time, crashed=crashed, missing=missing, name=name
    )


def _target(flights: Flights, samples: int) -> np.ndarray:
    """x, y, z and yaw of a target, [4]; of one that moves those of the first samples, [samples, 4]."""
    if not flights.moving:
        return np.append(flights.target_position, flights.target_yaw)
    return np.column_stack([flights.target_position, flights.target_yaw])[:samples]


def _one(
    where: str,
    clock: np.ndarray,
    arrays: dict[str, np.ndarray],
    target: np.ndarray,
    target_yaw: float,
    longest_gap: float,
    on_message: Callable[[str], None],
) -> Flights:
    """One flight [1, K] at 100 Hz from arrays [L, ...]."""
    clock, arrays = _increasing(where, clock, arrays, on_message)
    arrays, crashed = _until_lost(where, clock, arrays, on_message)
    known_until = clock[np.isfinite(arrays["position"]).all(axis=1)][-1]  # a log that goes on without a position ends
    grid = make_grid(where, clock, clock[0], known_until, longest_gap)
    error = max(grid.error(clock, arrays["position"][:, axis]) for axis in range(3))
    rate = (clock.size - 1) / (clock[-1] - clock[0])
    how = "taken as it is" if error == 0 else f"interpolated to 100 Hz, error at most about {error * 1e3:.2g} mm"
    on_message(f"{where}: {clock.size} samples at {rate:.1f} Hz, {how}")
    fields: dict[str, Any] = {}
    if "attitude" in arrays:
        fields["attitude"] = grid.attitudes(clock, arrays["attitude"])
    else:
        kept = np.isfinite(arrays["yaw"][:, 0])
        turned = np.full_like(arrays["yaw"], np.nan)
        turned[kept, 0] = np.unwrap(arrays["yaw"][kept, 0])  # so that it turns the short way between two samples
        half = grid.numbers("yaw", clock, turned)[:, 0] / 2
        fields["attitude"] = np.stack([0 * half, 0 * half, np.sin(half), np.cos(half)], axis=-1)
    for field in ("position", *OPTIONAL):
        width = len(COLUMNS[field][1].split())
        known = field == "position" or (field in arrays and np.isfinite(arrays[field]).all(axis=1).any())
        fields[field] = grid.numbers(field, clock, arrays[field]) if known else np.full((grid.time.size, width), np.nan)
    _remark(where, fields["position"], target, on_message)
    return Flights(
        **{field: values[None] for field, values in fields.items()},
        time=grid.time,
        crashed=np.array([crashed]),
        margins={},
        target_position=target,
        target_yaw=target_yaw,
        speed_bound=None,
        missing=tuple(field for field in OPTIONAL if np.isnan(fields[field]).all()),
        name=where,
        **LOGGED,
    )


def _until_lost(
    where: str, clock: np.ndarray, arrays: dict[str, np.ndarray], on_message: Callable[[str], None]
) -> tuple[dict[str, np.ndarray], bool]:
    """The arrays, and whether the flight crashed: where the position becomes infinite, the row before it is held.

    Raises:
        BadInput: there is no position.
    """
    lost = np.isinf(arrays["position"]).any(axis=1)
    arrays = {field: np.where(np.isinf(values), np.nan, values) for field, values in arrays.items()}
    first = int(np.argmax(lost)) if lost.any() else clock.size
    if not np.isfinite(arrays["position"][:first]).all(axis=1).any():
        raise BadInput(f"{where}: has no position. Allowed: numbers from the start on.")
    if first < clock.size:
        on_message(
            f"{where}: the position is infinite from {clock[first] - clock[0]:.2f} s on, which counts as a crash"
        )
        last = first - 1 - int(np.argmax(np.isfinite(arrays["position"][:first][::-1]).all(axis=1)))
        for values in arrays.values():
            values[first:] = values[last]
    return arrays, first < clock.size


def _increasing(
    where: str, clock: np.ndarray, arrays: dict[str, np.ndarray], on_message: Callable[[str], None]
) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """The rows with a time, in which it increases; of rows with the same time the last one counts."""
    timed = np.isfinite(clock)
    if np.count_nonzero(timed) < 2:
        raise BadInput(f"{where}: has {np.count_nonzero(timed)} rows with a time. Allowed: 2 or more.")
    clock, arrays = clock[timed], {field: values[timed] for field, values in arrays.items()}
    step = np.diff(clock)
    if (step < 0).any():
        at = int(np.argmax(step < 0))
        raise BadInput(
            f"{where}: the time goes back from {clock[at]:g} to {clock[at + 1]:g} s (sample {at + 2}). Allowed: a "
            "time that increases. Give one file per flight, or a column trial."
        )
    last = np.append(step > 0, True)
    if not last.all():
        on_message(
            f"{where}: left out, since the next one has the same time: {np.count_nonzero(~last)} of {last.size} samples"
        )
    bad = np.count_nonzero(~np.isfinite(arrays["position"]).all(axis=1)) + np.count_nonzero(~timed)
    if bad:
        on_message(f"{where}: without a time or a position: {bad} of {timed.size} samples")
    return clock[last], {field: values[last] for field, values in arrays.items()}


def _remark(where: str, position: np.ndarray, target: np.ndarray, on_message: Callable[[str], None]) -> None:
    """Say where the flight begins and ends, and whether there is a step at all."""
    start, end = (", ".join(f"{value:.3g}" for value in each) for each in (position[0], position[-1]))
    on_message(f"{where}: from ({start}) to ({end}) m, target ({', '.join(f'{value:.3g}' for value in target)}) m")
    if np.ptp(position, axis=0).max() < 1e-6:
        on_message(f"{where}: the vehicle never moves")
    elif np.linalg.norm(position - target, axis=1).max() <= POSITION_BAND:
        on_message(f"{where}: the vehicle begins within {POSITION_BAND * 100:g} cm of its target; there is no step")
