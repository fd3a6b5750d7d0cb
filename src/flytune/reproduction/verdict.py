"""Verdicts on claims, and the arithmetic by which every claim is judged."""

import dataclasses
from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
from jaxtyping import Shaped

from flytune.evaluation.statistics import bootstrap_interval, median

Verdict = Literal[
    "holds", "holds under a reading", "does not hold", "cannot be tested as printed", "cannot be tested with this study"
]

# Fixed before anything was measured: a claim about trials holds where the lower end of the interval of the share of
# trials that agree with it reaches this.
THRESHOLD = 0.95


@dataclasses.dataclass(frozen=True, kw_only=True)
class Measure:
    """One number that a verdict rests on, with its 95 % interval over seeds and trials."""

    what: str
    value: float | None  # None: infinite, or nothing to measure
    low: float | None = None
    high: float | None = None
    unit: str = "1"
    agrees: bool | None = None  # with the claim; None where the number only informs, or is missing
    missing: str = ""  # why there is nothing to measure

    def text(self) -> str:
        """The number with its unit and its interval."""

        def write(value: float | None) -> str:
            if value is None:
                return "-"
            return f"{100 * value:.1f} %" if self.unit == "share" else f"{value:.4g}"

        number, low, high = map(write, (self.value, self.low, self.high))
        interval = "" if self.low is None and self.high is None else f" [{low}, {high}]"
        return f"{number}{'' if self.unit in ('share', '1') else ' ' + self.unit}{interval}"


@dataclasses.dataclass(frozen=True, kw_only=True)
class JudgedClaim:
    """One claim of the paper, its verdict, and the numbers behind it."""

    item: str  # R23, H7
    claim: str
    verdict: Verdict
    reading: str  # the definition that the verdict rests on
    why: str  # one sentence
    measures: list[Measure]
    averaged: list[Measure] = dataclasses.field(default_factory=list)  # the same of the averaged weights

    def to_dict(self) -> dict[str, Any]:
        """Plain values, for JSON."""
        return dataclasses.asdict(self)


def share_of_trials(
    what: str, agreeing: Sequence[Shaped[np.ndarray, "N"]], threshold: float | None = THRESHOLD
) -> Measure:
    """The share of trials [seeds][trials] (bool) that agree with a claim.

    It agrees where the lower end of its interval reaches `threshold`; without a threshold it only informs.
    """
    values = [np.asarray(group, float) for group in agreeing if len(group)]
    if not values:
        return Measure(what=what, value=None, unit="share", missing="no trial counts")
    low, high = bootstrap_interval(values, lambda drawn: float(np.mean(drawn)))
    value = float(np.mean(np.concatenate(values)))
    agrees = None if threshold is None else low is not None and low >= threshold
    return Measure(what=what, value=value, low=low, high=high, unit="share", agrees=agrees)


def median_of_trials(what: str, values: Sequence[Shaped[np.ndarray, "N"]], unit: str) -> Measure:
    """The median of per-trial values [seeds][trials], which only informs."""
    low, high = bootstrap_interval(values)
    return Measure(what=what, value=median(np.concatenate(values)), low=low, high=high, unit=unit)


def decide(printed: Sequence[Measure], reading: Sequence[Measure] = ()) -> Verdict:
    """The verdict that the measures of a claim lead to.

    `holds` where every measure taken as printed agrees, `holds under a reading` where every measure of the reading
    does. Otherwise it does not hold, unless nothing disagrees: then it is a measure that is missing.
    """
    if printed and all(measure.agrees for measure in printed):
        return "holds"
    if reading and all(measure.agrees for measure in reading):
        return "holds under a reading"
    disagrees = any(measure.agrees is False for measure in reading or printed)
    return "does not hold" if disagrees else "cannot be tested with this study"
