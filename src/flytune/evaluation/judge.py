"""The judge: Flights in, one Judgement out, the same whoever flew. NumPy only."""

import dataclasses
from collections.abc import Mapping

import numpy as np
from jaxtyping import Bool, Float

from flytune.evaluation import lower_bounds, metrics
from flytune.evaluation.flights import Flights
from flytune.evaluation.statistics import finite, median, summary
from flytune.evaluation.table import AXES, response_line, response_text
from flytune.simulation import CRASH_DISTANCE

CHANNELS = (*AXES, "position")
SECONDARY_BANDS = {"2%": 0.02, "5%": 0.05}  # of each trial's own step

TIMES = ("median", "p25", "p75", "p95")
OVERSHOOTS = ("median", "p75", "p95")
ERRORS = ("median", "p75", "p95", "max")

PerTrial = Float[np.ndarray, "N"]
PerTrialFlag = Bool[np.ndarray, "N"]


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Judgement:
    """What N trials flew like, one value per trial and metric; `to_dict` and `str` summarise them.

    Every array is [N], in the order of the flights. +inf marks a trial that failed by the metric: one that did not
    settle, or never rose; and one that crashed, in every metric of the response. NaN marks a trial to which the
    metric does not apply: overshoot and rise time of a small step, efficiency of a start inside the band. Channels
    are x, y, z, yaw and position (the distance).

    Source: docs, definitions.
    """

    name: str
    task: str
    vehicle: str
    simulator: str
    seed: int
    initial_conditions: str
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
            "seed": int(self.seed),
            "starts": self.initial_conditions,
            "duration": self.duration,
            "axes": {axis: self._axis(axis) for axis in AXES},
            "position": {
                **_settling(self.settling_time["position"]),
                "overshoot": summary(self.overshoot["position"], OVERSHOOTS),
                "overshoot_raw": summary(self.overshoot_raw["position"], OVERSHOOTS),
                "steady_state_error": summary(self.steady_state_error["position"], ERRORS),
                "rms_error": summary(self.rms_error["position"], ERRORS),
            },
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
        }

    def _axis(self, axis: str) -> dict:
        return {
            "settled": self.settled(axis),
            "small_steps": _count(self.small_step[axis]),
            "settling_time": summary(self.settling_time[axis], TIMES),
            "rise_time": summary(self.rise_time[axis], TIMES),
            "overshoot": summary(self.overshoot[axis], OVERSHOOTS),
            "overshoot_raw": summary(self.overshoot_raw[axis], OVERSHOOTS),
            "steady_state_error": summary(self.steady_state_error[axis], ERRORS),
            "rms_error": summary(self.rms_error[axis], ERRORS),
            "itae": summary(self.itae[axis], ERRORS),
        }

    def table(self) -> str:
        """The response table for a terminal: plain text, one row per channel, '-' where a quantile is infinite."""
        return response_text(self.to_dict())

    __str__ = table

    def line(self) -> str:
        """The judgement in one line."""
        return response_line(self.to_dict())


def judge(flights: Flights) -> Judgement:
    """Judgement of recorded flights, by the same definitions whoever flew and in whichever world.

    A crashed trial is at +inf in every metric of the response, even where its step was small, so that it never
    disappears; it is then not among the small steps. An unsettled trial that did not crash keeps its measured
    overshoot and errors.

    In the secondary bands every trial counts, with the band its own step gives (for yaw the wrapped error at the
    start): a tiny step asks for a tiny band, which sensor noise alone may break, and a step of 0 for exactly no
    error.

    Source: docs, definitions; C5 of the paper's open points for the bands.
    """
    time = np.asarray(flights.time, dtype=np.float64)
    duration = round(flights.duration, 6)
    crashed = _crashed(flights)
    channels = _channels(flights, time, crashed)
    settling = {
        name: _fail(metrics.settling_time(channel.distance, time, channel.band), crashed)
        for name, channel in channels.items()
    }
    secondary = {
        band: {
            name: _fail(metrics.settling_time(channel.distance, time, share * np.abs(channel.distance[:, 0])), crashed)
            for name, channel in channels.items()
        }
        for band, share in SECONDARY_BANDS.items()
    }
    action = np.asarray(flights.action, dtype=np.float64)
    start = np.asarray(flights.position[:, 0], dtype=np.float64) - flights.target_position
    bound = lower_bounds.settling_time_bound(np.linalg.norm(start, axis=-1), flights.speed_bound)
    return Judgement(
        name=flights.name,
        task=flights.task,
        vehicle=flights.vehicle,
        simulator=flights.simulator,
        seed=flights.seed,
        initial_conditions=flights.initial_conditions,
        duration=duration,
        settling_time=settling,
        secondary_settling_time=secondary,
        rise_time={axis: channels[axis].of_step(metrics.rise_time(channels[axis].course, time)) for axis in AXES},
        overshoot={name: c.of_step(metrics.overshoot(c.course, c.band)) for name, c in channels.items()},
        overshoot_raw={name: c.of_step(metrics.overshoot(c.course)) for name, c in channels.items()},
        steady_state_error={name: _fail(c.steady_state_error, crashed) for name, c in channels.items()},
        rms_error={name: _fail(metrics.rms_error(c.distance, time), crashed) for name, c in channels.items()},
        itae={axis: _fail(metrics.itae(channels[axis].distance, time), crashed) for axis in AXES},
        small_step={name: c.small for name, c in channels.items()},
        peak_speed=metrics.peak_speed(np.asarray(flights.velocity, dtype=np.float64)),
        action_rms=metrics.action_rms(action),
        action_total_variation=metrics.action_total_variation(action),
        efficiency=lower_bounds.efficiency(bound, settling["position"]),
        infeasible=lower_bounds.infeasible(bound, duration, flights.margins),
        crashed=crashed,
        violated={name: np.any(margin < 0, axis=1) for name, margin in flights.margins.items()},
    )


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class _Channel:
    """The errors of one channel in the forms the metrics ask for; harmless zeros where the trial crashed."""

    course: Float[np.ndarray, "N K"]  # signed, continuous: overshoot and rise
    distance: Float[np.ndarray, "N K"]  # what the band is compared with: settling, RMS, ITAE
    steady_state_error: PerTrial
    band: float
    small: PerTrialFlag
    crashed: PerTrialFlag

    def of_step(self, values: PerTrial) -> PerTrial:
        """Values of a metric that needs a step: +inf where crashed, NaN where the step is small."""
        return _fail(np.where(self.small, np.nan, values), self.crashed)


def _channels(flights: Flights, time: Float[np.ndarray, "K"], crashed: PerTrialFlag) -> dict[str, _Channel]:
    """The five channels: signed errors (x, y, z), wrapped and unwrapped ones (yaw), a distance (position)."""

    def channel(course: np.ndarray, distance: np.ndarray, steady: np.ndarray, band: float, small: float) -> _Channel:
        return _Channel(
            course=course,
            distance=distance,
            steady_state_error=steady,
            band=band,
            small=(np.abs(course[:, 0]) < small) & ~crashed,
            crashed=crashed,
        )

    lost = crashed[:, None, None]
    error = np.where(lost, 0.0, np.asarray(flights.position, dtype=np.float64) - flights.target_position)
    attitude = np.where(lost, [0.0, 0.0, 0.0, 1.0], np.asarray(flights.attitude, dtype=np.float64))
    yaw = metrics.yaw_angle(attitude)
    turn, wrapped = metrics.unwrapped_yaw_error(yaw, flights.target_yaw), metrics.wrap_angle(yaw - flights.target_yaw)
    length = (metrics.POSITION_BAND, metrics.SMALL_STEP)
    channels = {
        axis: channel(e, e, metrics.steady_state_error(e, time), *length)
        for axis, e in zip("xyz", np.moveaxis(error, -1, 0), strict=True)
    }
    steady_yaw = metrics.steady_state_yaw_error(wrapped, time)
    channels["yaw"] = channel(turn, wrapped, steady_yaw, metrics.YAW_BAND, metrics.SMALL_TURN)
    along, steady = metrics.error_along_start(error), metrics.steady_state_position_error(error, time)
    channels["position"] = channel(along, np.linalg.norm(error, axis=-1), steady, *length)
    return channels


def _crashed(flights: Flights) -> PerTrialFlag:
    """Which trials are marked as crashed, left the ball around the target, or hold a state that is not finite."""
    states = (flights.position, flights.attitude, flights.velocity, flights.body_rate)
    lost = [~np.isfinite(state).all(axis=(1, 2)) for state in states]
    with np.errstate(over="ignore", invalid="ignore"):
        distance = np.linalg.norm(flights.position - flights.target_position, axis=-1)
    return np.logical_or.reduce([flights.crashed, (distance > CRASH_DISTANCE).any(axis=1), *lost])


def _fail(values: PerTrial, crashed: PerTrialFlag) -> PerTrial:
    return np.where(crashed, np.inf, values)


def _settling(settling_time: PerTrial) -> dict:
    return {"settled": _count(np.isfinite(settling_time)), "settling_time": summary(settling_time, TIMES)}


def _count(flags: PerTrialFlag) -> int:
    return int(np.count_nonzero(flags))
