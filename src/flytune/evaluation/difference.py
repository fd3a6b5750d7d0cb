"""Paired differences: one metric of a controller less that of another, trial by trial. NumPy and SciPy only."""

import dataclasses
import math
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from scipy.special import betainc

from flytune.evaluation.judge import Judgement, PerTrial
from flytune.evaluation.statistics import finite

FIELDS = {  # of the judgement: in words, and how a controller with more of it compares, how one with less
    "settling_time": ("settling time", "later", "earlier"),
    "overshoot": ("overshoot", "more", "less"),
    "steady_state_error": ("steady-state error", "farther off", "nearer"),
    "rms_error": ("RMS error", "larger", "smaller"),
    "tracking_error": ("tracking error", "farther off", "nearer"),
    "peak_speed": ("peak speed", "faster", "slower"),
    "action_rms": ("action, RMS", "harder", "more gently"),
    "action_total_variation": ("action, change", "more", "less"),
}
SHOWN = {"m": ("mm", 1e3), "rad": ("deg", math.degrees(1))}  # units of tables and figures, with their factors


@dataclasses.dataclass(frozen=True)
class Metric:
    """One number per trial of a judgement, the smaller the better (of speed and action: the less)."""

    field: str  # of the judgement
    channel: str | None  # x, y, z, yaw or position; None for a metric of the whole flight
    unit: str
    verb: str = ""  # what a controller does, for a sentence; "" where no sentence is made of it
    equal: str = ""  # the same, as much as another controller
    decimals: int = 2  # in a sentence

    @property
    def name(self) -> str:
        """The metric by the keys of `evaluate --json`: position.settling_time, peak_speed, action.rms."""
        return f"{self.channel}.{self.field}" if self.channel else self.field.replace("action_", "action.")

    @property
    def title(self) -> str:
        """The metric in words."""
        title = FIELDS[self.field][0]
        return f"{self.channel} {title}" if self.channel else title

    @property
    def ways(self) -> tuple[str, str]:
        """How a controller with more of it compares, and how one with less."""
        return FIELDS[self.field][1:]

    @property
    def outcomes(self) -> tuple[str, str]:
        """What a controller does in a trial without a number, and what in one with a number, for a sentence."""
        if self.field == "settling_time":
            return self.verb.replace("settles", "does not settle"), self.verb
        return "crashes", "does not crash"

    @property
    def neither(self) -> str:
        """What is said of two controllers that both have no number."""
        return f"neither {self.verb}" if self.field == "settling_time" else "both crash"

    @property
    def shown(self) -> tuple[str, float]:
        """The unit of tables and figures, and its factor."""
        return ("%", 100.0) if self.field == "overshoot" else SHOWN.get(self.unit, (self.unit, 1.0))

    def values(self, judgement: Judgement) -> PerTrial:
        """The metric of each trial; +inf where it failed, NaN where the metric does not apply.

        Speed and action stop at a crash, which makes them small: they are NaN for a crashed trial.
        """
        if self.field == "tracking_error":
            return judgement.tracking.mean_error if judgement.tracking else np.full(judgement.trials, np.nan)
        values = getattr(judgement, self.field)
        return values[self.channel] if self.channel else np.where(judgement.crashed, np.nan, values)


METRICS = (
    Metric("settling_time", "position", "s", "settles", "as early as"),
    *(Metric("settling_time", axis, "s") for axis in "xyz"),
    Metric("settling_time", "yaw", "s", "settles in yaw", "as early as"),
    Metric("overshoot", "position", "1", "overshoots", "as much as"),
    Metric("overshoot", "yaw", "1"),
    Metric("steady_state_error", "position", "m", "stays", "as near as"),
    Metric("steady_state_error", "yaw", "rad", "points", "as near as", decimals=3),
    Metric("rms_error", "position", "m"),
    Metric("rms_error", "yaw", "rad"),
    Metric("peak_speed", None, "m/s", "peaks", "as fast as"),
    Metric("action_rms", None, "1", "acts (RMS)", "as hard as", decimals=4),
    Metric("action_total_variation", None, "1", "changes its action per step", "as much as", decimals=4),
)


TRACKING = Metric("tracking_error", None, "m", "tracks", "as closely as")


def metrics_of(judgements: Sequence[Judgement]) -> tuple[Metric, ...]:
    """The metrics in which controllers are compared; the mean tracking error where the target moves for all."""
    return (*METRICS, TRACKING) if all(judgement.tracking for judgement in judgements) else METRICS


@dataclasses.dataclass(frozen=True, kw_only=True)
class Difference:
    """One metric of a controller less that of the reference, trial by trial; negative is better.

    Median and interval may be infinite: +inf where the controller failed and the reference did not, -inf the other way
    round. They are NaN where no trial could be compared.
    """

    name: str
    metric: Metric
    median: float
    low: float  # of the 95 % interval of the median
    high: float
    better: int  # trials in which the controller has the smaller value, or the reference alone failed
    worse: int
    tied: int  # trials with equal values, or in which both failed
    left_out: int  # trials to which the metric does not apply
    both_failed: int = 0  # of the tied ones

    @property
    def compared(self) -> int:
        """Number of trials that were compared."""
        return self.better + self.worse + self.tied

    def to_dict(self) -> dict:
        """Plain Python values; None where infinite: `better` and `worse` then say to which side."""
        return {
            "who": self.name,
            "metric": self.metric.name,
            "unit": self.metric.unit,
            **{name: finite(getattr(self, name)) for name in ("median", "low", "high")},
            **{name: getattr(self, name) for name in ("better", "worse", "tied", "left_out")},
        }


def paired_difference(controller: PerTrial, reference: PerTrial) -> PerTrial:
    """Controller less reference, trial by trial: +inf where only the controller failed, -inf where only the other did.

    0 where both failed: they tie, since nothing says which failed worse. NaN where the metric does not apply to either,
    or applies to one of two that did not fail.
    """
    lost, beaten = np.isposinf(controller), np.isposinf(reference)
    with np.errstate(invalid="ignore"):
        difference = controller - reference
    return np.select([lost & beaten, lost, beaten], [0.0, np.inf, -np.inf], difference)


def compare_metric(controller: Judgement, reference: Judgement, metric: Metric) -> Difference:
    """How a controller differs from the reference in one metric, with the 95 % bootstrap interval of the median."""
    mine, other = metric.values(controller), metric.values(reference)
    paired = paired_difference(mine, other)
    left_out = np.isnan(paired)
    middle, low, high = median_and_interval(paired[~left_out])
    flags = {"better": paired < 0, "worse": paired > 0, "tied": paired == 0, "left_out": left_out,
             "both_failed": np.isposinf(mine) & np.isposinf(other)}  # fmt: skip
    counts = {name: int(np.count_nonzero(flag)) for name, flag in flags.items()}
    return Difference(name=controller.name, metric=metric, median=middle, low=low, high=high, **counts)


def median_and_interval(values: Float[np.ndarray, "M"]) -> tuple[float, float, float]:
    """Median of independent values, and the ends of its 95 % bootstrap interval; NaN without a value.

    The median of a resample is one of the values, and at most the k-th smallest of M if at least ceil(M / 2) of M
    draws are, each with a chance of k / M:

        P(median of a resample <= k-th) = I_{k / M}(m, M - m + 1),    m = ceil(M / 2), I the incomplete beta function

    This is the limit of `bootstrap_interval` of one group for many draws. Infinite values, which have either sign in
    a difference, need no special care.

    Source: Efron, Bootstrap methods: another look at the jackknife (1979), section 3.
    """
    if values.size == 0:
        return np.nan, np.nan, np.nan
    ordered, middle = np.sort(values), (values.size + 1) // 2
    chance = betainc(middle, values.size - middle + 1, np.arange(1, values.size + 1) / values.size)
    low, high = np.searchsorted(chance, [(1 - 0.95) / 2, (1 + 0.95) / 2])
    return float(ordered[middle - 1]), float(ordered[low]), float(ordered[high])
