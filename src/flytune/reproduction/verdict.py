"""What a verdict is, and the arithmetic every claim is judged with."""

import dataclasses
from collections.abc import Sequence
from typing import Any, Literal

import numpy as np

from flytune.evaluation.statistics import bootstrap_interval, finite

Word = Literal["holds", "holds under a reading", "does not hold", "cannot be tested as printed"]

# Fixed before anything was measured: a claim about trials holds where the lower end of the interval of the share of
# trials that agree with it reaches this.
SHARE = 0.95


@dataclasses.dataclass(frozen=True, kw_only=True)
class Measure:
    """One number a verdict rests on, with its 95 % interval over seeds and trials."""

    what: str
    value: float | None  # None: infinite, or nothing to measure
    low: float | None = None
    high: float | None = None
    unit: str = "1"
    agrees: bool | None = None  # with the claim; None where it only informs

    def text(self) -> str:
        """The number as a reader wants it."""
        if self.unit == "share":
            number, low, high = (_percent(part) for part in (self.value, self.low, self.high))
        else:
            number, low, high = (_plain(part) for part in (self.value, self.low, self.high))
        interval = "" if self.low is None and self.high is None else f" [{low}, {high}]"
        return f"{number}{'' if self.unit in ('share', '1') else ' ' + self.unit}{interval}"


@dataclasses.dataclass(frozen=True, kw_only=True)
class Verdict:
    """What became of one claim."""

    item: str  # R23, H7, C1
    claim: str
    word: Word
    reading: str  # the definition the verdict rests on
    why: str  # one sentence
    measures: list[Measure]
    average: list[Measure] = dataclasses.field(default_factory=list)  # the same of the averaged weights

    def to_dict(self) -> dict[str, Any]:
        """Plain values, for JSON."""
        return dataclasses.asdict(self)


def share(what: str, agreeing: Sequence[np.ndarray], threshold: float | None = SHARE) -> Measure:
    """The share of trials [seeds][trials] (bool) that agree with a claim.

    It agrees where the lower end of its interval reaches `threshold`; without one it only informs.
    """
    values = [np.asarray(group, float) for group in agreeing if len(group)]
    if not values:
        return Measure(what=what, value=None, unit="share", agrees=None)
    low, high = bootstrap_interval(values, lambda drawn: float(np.mean(drawn)))
    value = float(np.mean(np.concatenate(values)))
    agrees = None if threshold is None else low is not None and low >= threshold
    return Measure(what=what, value=value, low=low, high=high, unit="share", agrees=agrees)


def middle(what: str, values: Sequence[np.ndarray], unit: str, at_most: float | None = None) -> Measure:
    """The median of per-trial values [seeds][trials], and whether the upper end of its interval is within `at_most`."""
    low, high = bootstrap_interval(values)
    known = np.sort(np.concatenate(values))
    known = known[~np.isnan(known)]
    value = finite(known[int(np.ceil(0.5 * known.size)) - 1]) if known.size else None
    agrees = None if at_most is None else high is not None and high <= at_most
    return Measure(what=what, value=value, low=low, high=high, unit=unit, agrees=agrees)


def decide(printed: Sequence[Measure], reading: Sequence[Measure] = ()) -> Word:
    """`holds` where every measure taken as printed agrees, `holds under a reading` where every one of the reading's
    does, `does not hold` elsewhere."""
    if printed and all(measure.agrees for measure in printed):
        return "holds"
    if reading and all(measure.agrees for measure in reading):
        return "holds under a reading"
    return "does not hold"


def _percent(value: float | None) -> str:
    return "-" if value is None else f"{100 * value:.1f} %"


def _plain(value: float | None) -> str:
    return "-" if value is None else f"{value:.4g}"
