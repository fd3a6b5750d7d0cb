"""Paired differences: one metric of a controller less that of another, trial by trial. NumPy and SciPy only."""

import dataclasses

import numpy as np
from jaxtyping import Float
from scipy.special import betainc

from flytune.evaluation.judge import AXES, Judgement, PerTrial
from flytune.evaluation.statistics import finite


@dataclasses.dataclass(frozen=True, kw_only=True)
class Metric:
    """One number per trial of a judgement, the smaller the better (of speed and action: the less)."""

    field: str  # of the judgement
    channel: str | None  # x, y, z, yaw or position; None for a metric of the whole flight
    unit: str

    @property
    def name(self) -> str:
        """The metric by the keys of `evaluate --json`: position.settling_time, peak_speed, action.rms."""
        return f"{self.channel}.{self.field}" if self.channel else self.field.replace("action_", "action.")

    def values(self, judgement: Judgement) -> PerTrial:
        """The metric of each trial; +inf where it failed, NaN where the metric does not apply.

        Speed and action stop at a crash, which makes them small: they are NaN for a crashed trial.
        """
        values = getattr(judgement, self.field)
        return values[self.channel] if self.channel else np.where(judgement.crashed, np.nan, values)


METRICS = (
    *(Metric(field="settling_time", channel=channel, unit="s") for channel in ("position", *AXES)),
    Metric(field="overshoot", channel="position", unit="1"),
    Metric(field="overshoot", channel="yaw", unit="1"),
    Metric(field="steady_state_error", channel="position", unit="m"),
    Metric(field="steady_state_error", channel="yaw", unit="rad"),
    Metric(field="rms_error", channel="position", unit="m"),
    Metric(field="rms_error", channel="yaw", unit="rad"),
    Metric(field="peak_speed", channel=None, unit="m/s"),
    Metric(field="action_rms", channel=None, unit="1"),
    Metric(field="action_total_variation", channel=None, unit="1"),
)


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

    @property
    def compared(self) -> int:
        """Number of trials that were compared."""
        return self.better + self.worse + self.tied

    def to_dict(self) -> dict:
        """The difference as plain Python values; None where infinite, `better` and `worse` then tell to which side."""
        return {
            "who": self.name,
            "metric": self.metric.name,
            "unit": self.metric.unit,
            "median": finite(self.median),
            "low": finite(self.low),
            "high": finite(self.high),
            "better": self.better,
            "worse": self.worse,
            "tied": self.tied,
            "left_out": self.left_out,
        }


def paired_difference(controller: PerTrial, reference: PerTrial) -> PerTrial:
    """Controller less reference, trial by trial: +inf where only the controller failed, -inf where only the other did.

    0 where both failed, which is a tie and no knowledge of who failed worse. NaN where the metric does not apply to
    either, or applies to one of two that did not fail.
    """
    lost, beaten = np.isposinf(controller), np.isposinf(reference)
    with np.errstate(invalid="ignore"):
        difference = controller - reference
    return np.select([lost & beaten, lost, beaten], [0.0, np.inf, -np.inf], difference)


def compare_metric(controller: Judgement, reference: Judgement, metric: Metric) -> Difference:
    """How a controller differs from the reference in one metric, with the 95 % bootstrap interval of the median."""
    paired = paired_difference(metric.values(controller), metric.values(reference))
    applies = ~np.isnan(paired)
    middle, low, high = median_and_interval(paired[applies])
    return Difference(
        name=controller.name,
        metric=metric,
        median=middle,
        low=low,
        high=high,
        better=int(np.count_nonzero(paired < 0)),
        worse=int(np.count_nonzero(paired > 0)),
        tied=int(np.count_nonzero(paired == 0)),
        left_out=int(np.count_nonzero(~applies)),
    )


def median_and_interval(values: Float[np.ndarray, "M"], level: float = 0.95) -> tuple[float, float, float]:
    """Median of independent values, and the ends of its bootstrap interval; NaN without a value.

    The median of a resample is one of the values, and at most the k-th smallest of M if at least ceil(M / 2) of M
    draws are, each with a chance of k / M:

        P(median of a resample <= k-th) = I_{k / M}(m, M - m + 1),    m = ceil(M / 2), I the incomplete beta function

    This is `bootstrap_interval` of one group with endless draws, in no time; and infinite values, which may be of
    either sign in a difference, need no care.

    Source: Efron, Bootstrap methods: another look at the jackknife (1979), section 3.
    """
    if values.size == 0:
        return np.nan, np.nan, np.nan
    ordered, middle = np.sort(values), (values.size + 1) // 2
    chance = betainc(middle, values.size - middle + 1, np.arange(1, values.size + 1) / values.size)
    low, high = np.searchsorted(chance, [(1 - level) / 2, (1 + level) / 2])
    return float(ordered[middle - 1]), float(ordered[low]), float(ordered[high])
