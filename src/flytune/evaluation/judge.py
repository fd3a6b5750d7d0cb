"""The judge: one Judgement of Flights, by the same definitions for every controller and simulator. NumPy only."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from flytune.evaluation import lower_bounds, metrics
from flytune.evaluation.flights import Flights, Labels
from flytune.evaluation.statistics import finite, median, summary
from flytune.evaluation.table import AXES, response_line, response_text
from flytune.evaluation.tracking import Tracking, track
from flytune.simulation import CRASH_DISTANCE

CHANNELS = (*AXES, "position")
SECONDARY_BANDS = {"2%": 0.02, "5%": 0.05}  # of each trial's own step

TIMES = ("median", "p25", "p75", "p95")
OVERSHOOTS = ("median", "p75", "p95")
ERRORS = ("median", "p75", "p95", "max")
RESPONSE = {  # metric of a channel -> its quantiles in `to_dict`
    "settling_time": TIMES,
    "rise_time": TIMES,
    "overshoot": OVERSHOOTS,
    "overshoot_raw": OVERSHOOTS,
    "steady_state_error": ERRORS,
    "rms_error": ERRORS,
    "itae": ERRORS,
}
OF_AXES = ("rise_time", "itae")  # metrics that the position does not have

PerTrial = Float[np.ndarray, "N"]
PerTrialFlag = Bool[np.ndarray, "N"]


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Judgement(Labels):
    """The step response of N trials, one value per trial and metric; `to_dict` and `str` summarise them.

    Every array is [N], in the order of the flights. +inf marks a trial that failed by the metric: one that did not
    settle, or never rose; and one that crashed, in every metric of the response. NaN marks a trial to which the
    metric does not apply: overshoot and rise time of a small step, efficiency of a start inside the band. Channels
    are x, y, z, yaw and position (the distance).

    Source: docs, definitions.
    """

    duration: float  # s
    settling_time: Mapping[str, PerTrial]  # channel -> s
    secondary_settling_time: Mapping[str, Mapping[str, PerTrial]]  # "2%" | "5%" -> channel -> s
    rise_time: Mapping[str, PerTrial]  # axis -> s
    overshoot: Mapping[str, PerTrial]  # channel -> fraction of the step; excursions inside the band count 0
    overshoot_raw: Mapping[str, PerTrial]  # channel -> fraction of the step
    steady_state_error: Mapping[str, PerTrial]  # channel -> m or rad
    rms_error: Mapping[str, PerTrial]  # channel -> m or rad
    itae: Mapping[str, PerTrial]  # axis -> m s^2 or rad s^2
    small_step: Mapping[str, PerTrialFlag]  # channel -> left out of overshoot and rise time
    peak_speed: PerTrial  # m/s, as observed, crashed or not
    action_rms: PerTrial  # 1, as observed
    action_total_variation: PerTrial  # 1 per step and motor, as observed
    efficiency: PerTrial  # 1, physical bound over settling time of the position
    infeasible: PerTrialFlag
    crashed: PerTrialFlag
    violated: Mapping[str, PerTrialFlag]  # termination -> crossed at some sample
    tracking: Tracking | None = None  # of a target that moves
    steps: tuple["StepJudgement", ...] = ()  # of a target that steps

    def __repr__(self) -> str:
        settled, took = self.settled("position"), median(self.settling_time["position"])
        time = f", median {took:.2f} s" if took is not None else ""
        return f"Judgement({self.name or 'controller'} on {self.task}, {settled}/{self.trials} settled{time})"

    @property
    def trials(self) -> int:
        """Number of trials N."""
        return self.crashed.size

    def settled(self, channel: str) -> int:
        """Number of trials that settled on x, y, z, yaw or position."""
        return _count(np.isfinite(self.settling_time[channel]))

    def to_dict(self) -> dict:
        """The object that `evaluate --json` prints, of plain Python values; None where a quantile is infinite."""
        return {
            "schema": 1,
            "who": self.name,
            "task": self.task,
            "vehicle": self.vehicle,
            "world": self.simulator,
            "trials": self.trials,
            "seed": None if self.seed is None else int(self.seed),
            "starts": self.initial_conditions,
            "duration": self.duration,
            "axes": {
                axis: {
                    "settled": self.settled(axis),
                    "small_steps": _count(self.small_step[axis]),
                    **self._response(axis),
                }
                for axis in AXES
            },
            "position": {"settled": self.settled("position"), **self._response("position")},
            "secondary": {
                band: {channel: _settling(values) for channel, values in channels.items()}
                for band, channels in self.secondary_settling_time.items()
            },
            "infeasible": _count(self.infeasible),
            "crashed": _count(self.crashed),
            "violations": {name: _count(flags) for name, flags in self.violated.items()},
            "peak_speed": summary(self.peak_speed, ("median", "p95")),
            "action": {
                "rms": finite(np.sqrt(np.mean(np.square(self.action_rms)))),
                "total_variation": finite(np.mean(self.action_total_variation)),
            },
            "efficiency": {"median": median(self.efficiency)},
            "dial": dict(self.dial) or None,
            "conditions": None,
            **({"made_for": self.made_for} if self.made_for else {}),
            **({"set": dict(self.changes)} if self.changes else {}),
            **({"tracking": self.tracking.to_dict()} if self.tracking else {}),
            **({"steps": [step.to_dict() for step in self.steps]} if self.steps else {}),
        }

    def _response(self, channel: str) -> dict:
        fields = [field for field in RESPONSE if channel in getattr(self, field)]
        return {field: summary(getattr(self, field)[channel], RESPONSE[field]) for field in fields}

    def table(self) -> str:
        """The response table for a terminal: plain text, one row per channel, '-' where a quantile is infinite."""
        return response_text(self.to_dict())

    __str__ = table

    def line(self) -> str:
        """The judgement in one line."""
        return response_line(self.to_dict())


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class StepJudgement:
    """The response to one step of a target that steps, on its own: times count from the step."""

    begin: float  # s from the start of the trial
    target: tuple[float, ...]  # x, y, z in m and yaw in rad
    judgement: Judgement

    def to_dict(self) -> dict:
        """Plain Python values, as in `Judgement.to_dict`."""
        whole = self.judgement.to_dict()
        kept = ("duration", "axes", "position", "crashed", "infeasible")
        return {"begin": self.begin, "target": list(self.target), **{name: whole[name] for name in kept}}


def judge(flights: Flights) -> Judgement:
    """Judgement of recorded flights, by the same definitions for every controller and simulator.

    A crashed trial is at +inf in every metric of the response, even where its step was small, so that it never
    disappears; it is then not among the small steps. An unsettled trial that did not crash keeps its measured
    overshoot and errors.

    In the secondary bands every trial counts, with a band in proportion to its own step (for yaw the wrapped error at
    the start): a tiny step has a tiny band, which sensor noise alone may leave.

    Of a target that moves, errors are those from its place at each instant; rise time, overshoot and efficiency do not
    apply. `tracking` tells how it is followed, or `steps` the response to each of its steps.

    Source: docs, definitions; C5 of the paper's open points for the bands.
    """
    time = np.asarray(flights.time, dtype=np.float64)
    duration = round(flights.duration, 6)
    crashed = _crashed(flights)
    responses = {name: channel.response(time, crashed) for name, channel in _channels(flights, time, crashed).items()}
    action, velocity = _double(flights.action), _double(flights.velocity)
    unknown = np.full(flights.trials, np.nan)  # of what the log of a flight lacks
    start = np.asarray(flights.start_error, dtype=np.float64)
    bound = (
        np.zeros(flights.trials)
        if flights.moving
        else lower_bounds.settling_time_bound(np.linalg.norm(start, axis=-1), flights.speed_bound)
    )
    fields: dict[str, Any] = {field.name: getattr(flights, field.name) for field in dataclasses.fields(Labels)}
    for field in (*RESPONSE, "small_step"):
        fields[field] = {name: responses[name][field] for name in (AXES if field in OF_AXES else CHANNELS)}
    if flights.moving:
        for field in ("rise_time", "overshoot", "overshoot_raw"):
            fields[field] = {name: np.full(flights.trials, np.nan) for name in fields[field]}
    parts = flights.steps
    return Judgement(
        **fields,
        duration=duration,
        secondary_settling_time={
            band: {name: response[band] for name, response in responses.items()} for band in SECONDARY_BANDS
        },
        peak_speed=unknown if "velocity" in flights.missing else metrics.peak_speed(velocity),
        action_rms=unknown if "action" in flights.missing else metrics.action_rms(action),
        action_total_variation=unknown if "action" in flights.missing else metrics.action_total_variation(action),
        efficiency=lower_bounds.efficiency(bound, responses["position"]["settling_time"]),
        infeasible=lower_bounds.infeasible(bound, duration, flights.margins),
        crashed=crashed,
        violated={name: np.any(margin < 0, axis=1) for name, margin in flights.margins.items()},
        tracking=track(flights, crashed) if flights.moving and not parts else None,
        steps=_judge_steps(parts),
    )


def _judge_steps(parts: Sequence[Flights]) -> tuple[StepJudgement, ...]:
    """The judgement of each step; a step ends with the sample before the next one."""
    begins = np.cumsum([0.0, *(part.time[-1] + part.time[1] for part in parts[:-1])]) if parts else []
    return tuple(
        StepJudgement(
            begin=round(float(begin), 6),
            target=(*part.target_position.tolist(), part.target_yaw),
            judgement=judge(part),
        )
        for begin, part in zip(begins, parts, strict=True)
    )


@dataclasses.dataclass(frozen=True, eq=False)
class _Channel:
    """The errors of one channel in the forms that the metrics need; zeros where the trial crashed."""

    course: Float[np.ndarray, "N K"]  # signed, continuous: overshoot and rise
    distance: Float[np.ndarray, "N K"]  # what the band is compared with: settling, RMS, ITAE
    steady_state_error: PerTrial
    band: float = metrics.POSITION_BAND
    small_step: float = metrics.SMALL_STEP

    def response(self, time: Float[np.ndarray, "K"], crashed: PerTrialFlag) -> dict[str, np.ndarray]:
        """Each metric, and the settling time in each secondary band: +inf where crashed."""
        small = (np.abs(self.course[:, 0]) < self.small_step) & ~crashed
        bands = {"settling_time": self.band}
        bands |= {name: share * np.abs(self.distance[:, 0]) for name, share in SECONDARY_BANDS.items()}
        of_step = {
            "rise_time": metrics.rise_time(self.course, time),
            "overshoot": metrics.overshoot(self.course, self.band),
            "overshoot_raw": metrics.overshoot(self.course),
        }
        values = {
            **{name: metrics.settling_time(self.distance, time, band) for name, band in bands.items()},
            **{name: np.where(small, np.nan, metric) for name, metric in of_step.items()},
            "steady_state_error": self.steady_state_error,
            "rms_error": metrics.rms_error(self.distance, time),
            "itae": metrics.itae(self.distance, time),
        }
        return {name: np.where(crashed, np.inf, metric) for name, metric in values.items()} | {"small_step": small}


def _channels(flights: Flights, time: Float[np.ndarray, "K"], crashed: PerTrialFlag) -> dict[str, _Channel]:
    """The five channels: signed errors (x, y, z), wrapped and unwrapped ones (yaw), a distance (position)."""
    lost = crashed[:, None, None]
    error = np.where(lost, 0.0, _double(flights.position) - flights.target_position)
    attitude = np.where(lost, [0.0, 0.0, 0.0, 1.0], _double(flights.attitude))
    yaw = metrics.yaw_angle(attitude)
    turned, aim = (yaw - flights.target_yaw, 0.0) if flights.moving else (yaw, flights.target_yaw)
    turn, wrapped = metrics.unwrapped_yaw_error(turned, aim), metrics.wrap_angle(yaw - flights.target_yaw)
    along, distance = metrics.error_along_start(error), np.linalg.norm(error, axis=-1)
    steady_yaw = metrics.steady_state_yaw_error(wrapped, time)
    return {
        **{name: _Channel(error[..., axis], error[..., axis], metrics.steady_state_error(error[..., axis], time))
           for axis, name in enumerate("xyz")},
        "yaw": _Channel(turn, wrapped, steady_yaw, metrics.YAW_BAND, metrics.SMALL_TURN),
        "position": _Channel(along, distance, metrics.steady_state_position_error(error, time)),
    }  # fmt: skip


def _crashed(flights: Flights) -> PerTrialFlag:
    """Which trials are marked as crashed, left the ball around the target, or hold a state that is not finite."""
    fields = [name for name in ("position", "attitude", "velocity", "body_rate") if name not in flights.missing]
    lost = [~np.isfinite(getattr(flights, name)).all(axis=(1, 2)) for name in fields]
    with np.errstate(over="ignore", invalid="ignore"):
        distance = np.linalg.norm(flights.position - flights.target_position, axis=-1)
    radius = np.maximum(CRASH_DISTANCE, 2 * distance[:, :1])  # a start far away doubles its own distance
    return np.logical_or.reduce([flights.crashed, (distance > radius).any(axis=1), *lost])


def _settling(settling_time: PerTrial) -> dict:
    return {"settled": _count(np.isfinite(settling_time)), "settling_time": summary(settling_time, TIMES)}


def _double(values: np.ndarray) -> np.ndarray:
    """Values in double precision and in one order in memory: another order adds up to other last bits."""
    return np.ascontiguousarray(values, dtype=np.float64)


def _count(flags: PerTrialFlag) -> int:
    return int(np.count_nonzero(flags))
