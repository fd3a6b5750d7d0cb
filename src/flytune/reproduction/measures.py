"""What is measured for each claim about flights, as printed and under our reading (`claims.toml` has the words)."""

import dataclasses
import math
from collections.abc import Callable

import numpy as np

from flytune.evaluation.judge import Judgement
from flytune.evaluation.metrics import POSITION_BAND, YAW_BAND
from flytune.evaluation.table import AXES
from flytune.reproduction.evidence import Evidence, Flown
from flytune.reproduction.study import ROLES
from flytune.reproduction.verdict import Measure, middle, share

FASTER = (("acrobatic", "baseline"), ("baseline", "inspection"))
OTHERS = ("baseline", "acrobatic")
PerTrial = Callable[[Judgement], np.ndarray]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Measured:
    """The numbers of one claim; a verdict rests on the first two."""

    printed: list[Measure] = dataclasses.field(default_factory=list)  # the claim in the strict sense of its words
    reading: list[Measure] = dataclasses.field(default_factory=list)  # under our reading
    aside: list[Measure] = dataclasses.field(default_factory=list)  # what helps to understand


def _values(evidence: Evidence, role: str, flown: Flown, of: PerTrial, condition: str = "fair") -> list[np.ndarray]:
    return [of(judgement) for judgement in evidence.seat(role, flown, condition).judgements]


def _pairs(
    evidence: Evidence, first: str, second: str, flown: Flown, condition: str = "fair"
) -> list[tuple[Judgement, Judgement]]:
    judged = (evidence.seat(role, flown, condition).judgements for role in (first, second))
    return list(zip(*judged, strict=True))


def damping(evidence: Evidence, flown: Flown) -> Measured:
    """R23: whether responses ever pass their target in x, y or z."""

    def never_past(table: dict[str, np.ndarray]) -> np.ndarray:
        return np.all([np.nan_to_num(table[axis], nan=0.0, posinf=np.inf) <= 0 for axis in "xyz"], axis=0)

    def rows(words: str, of: PerTrial, condition: str) -> list[Measure]:
        return [
            share(f"{role}: trials that never pass the target in x, y, z{words}",
                  _values(evidence, role, flown, of, condition))
            for role in ROLES
        ]  # fmt: skip

    return Measured(
        printed=rows("", lambda j: never_past(dict(j.overshoot_raw)), "printed"),
        reading=rows(" by more than the band", lambda j: never_past(dict(j.overshoot)), "fair"),
    )


def steady_state(evidence: Evidence, flown: Flown) -> Measured:
    """R23: how near to the target trials end."""

    def within(judgement: Judgement) -> np.ndarray:
        near = [judgement.steady_state_error[axis] <= POSITION_BAND for axis in "xyz"]
        return np.all([*near, judgement.steady_state_error["yaw"] <= YAW_BAND], axis=0)

    def position(judgement: Judgement) -> np.ndarray:
        return judgement.steady_state_error["position"]

    def yaw(judgement: Judgement) -> np.ndarray:
        return np.degrees(judgement.steady_state_error["yaw"])

    aside = []
    for role in ROLES:
        aside.append(middle(f"{role}: steady-state error, position", _values(evidence, role, flown, position), "m"))
        aside.append(middle(f"{role}: steady-state error, yaw", _values(evidence, role, flown, yaw), "deg"))
    reading = [
        share(f"{role}: trials within 2 cm in x, y, z and 3.6 deg in yaw", _values(evidence, role, flown, within))
        for role in ROLES
    ]
    return Measured(reading=reading, aside=aside)


def order(evidence: Evidence, flown: Flown) -> Measured:
    """R24: which behaviour settles first, from the same start and on the same noise."""

    def rows(condition: str, words: str, feasible: bool) -> list[Measure]:
        return [
            share(
                f"{fast} settles before {slow}, {words}",
                [_sooner(a, b, feasible) for a, b in _pairs(evidence, fast, slow, flown, condition)],
            )
            for fast, slow in FASTER
        ]

    aside = [
        middle(
            f"{role}: position settling time",
            _values(evidence, role, flown, lambda j: j.settling_time["position"]),
            "s",
        )
        for role in ROLES
    ]
    for fast, slow in FASTER:
        pairs = _pairs(evidence, fast, slow, flown)
        times = [[judged.secondary_settling_time["5%"]["position"] for judged in pair] for pair in pairs]
        sooner = [(early < late) & np.isfinite(late) for early, late in times]
        aside.append(share(f"{fast} settles before {slow} within 5 % of the trial's own distance", sooner, None))
    return Measured(
        printed=rows("printed", "all trials of 10 s", feasible=False),
        reading=rows("fair", "feasible trials", feasible=True),
        aside=aside,
    )


def _sooner(first: Judgement, second: Judgement, feasible: bool) -> np.ndarray:
    """Whether each trial of the first settles before the same trial of the second, which settles, too.

    Where one of them never settles there are no two settling times that could be in an order.
    """
    late = second.settling_time["position"]
    sooner = (first.settling_time["position"] < late) & np.isfinite(late)
    return sooner[~first.infeasible & ~second.infeasible] if feasible else sooner


def overshoot(evidence: Evidence, flown: Flown) -> Measured:
    """R25: the interquartile range of the overshoot per axis, and that of yaw beside the others."""

    def rows(words: str, of: Callable[[Judgement], dict[str, np.ndarray]], condition: str) -> list[Measure]:
        found = []
        for role in ROLES:
            tables = _values(evidence, role, flown, of, condition)  # pyright: ignore[reportArgumentType]
            pooled = {axis: np.concatenate([table[axis] for table in tables]) for axis in AXES}
            quartiles = {axis: (_quantile(pooled[axis], 0.25), _quantile(pooled[axis], 0.75)) for axis in AXES}
            for axis in "xyz":
                low, high = quartiles[axis]
                spread = high - low if math.isfinite(high) else None
                what = f"{role}: interquartile range of the {words} overshoot in {axis}"
                found.append(Measure(what=what, value=spread, unit="of the step", agrees=spread == 0))
            more = quartiles["yaw"][1] - max(quartiles[axis][1] for axis in "xyz")
            what = f"{role}: upper quartile of yaw's {words} overshoot less the largest of x, y, z"
            found.append(Measure(what=what, value=more if math.isfinite(more) else None, unit="of the step",
                                 agrees=more > 0))  # fmt: skip
        return found

    return Measured(
        printed=rows("raw", lambda j: dict(j.overshoot_raw), "printed"),
        reading=rows("banded", lambda j: dict(j.overshoot), "fair"),
    )


def _quantile(values: np.ndarray, level: float) -> float:
    known = np.sort(values[~np.isnan(values)])
    return float(known[max(math.ceil(level * known.size) - 1, 0)]) if known.size else math.inf


def all_settle(evidence: Evidence, flown: Flown) -> Measured:
    """R26: how many trials settle at all."""

    def settled(judgement: Judgement) -> np.ndarray:
        every = np.all([np.isfinite(judgement.settling_time[axis]) for axis in AXES], axis=0)
        return every[~judgement.infeasible]

    reading = [
        share(f"{role}: feasible trials that settle on all four axes", _values(evidence, role, flown, settled))
        for role in ROLES
    ]
    return Measured(reading=reading)


def actuation(evidence: Evidence, flown: Flown) -> Measured:
    """R29: how hard the motors work, trial by trial, over the same 10 s."""
    measures = []
    for other in OTHERS:
        pairs = _pairs(evidence, "inspection", other, flown, "printed")
        measures.append(share(f"inspection's RMS of the action is below {other}'s",
                              [a.action_rms < b.action_rms for a, b in pairs]))  # fmt: skip
        measures.append(share(f"inspection's total variation of the action is below {other}'s",
                              [a.action_total_variation < b.action_total_variation for a, b in pairs]))  # fmt: skip
    aside = [
        middle(f"{role}: mean rotor speed", list(evidence.seat(role, flown, "printed").rotor_speed), "rpm")
        for role in ROLES
    ]
    return Measured(reading=measures, aside=aside)


def inspection_first(evidence: Evidence, flown: Flown) -> Measured:
    """R29: whether inspection settles before the other two."""
    return Measured(
        printed=[
            share(
                f"inspection settles before {other}, feasible trials",
                [_sooner(a, b, True) for a, b in _pairs(evidence, "inspection", other, flown)],
            )
            for other in OTHERS
        ]
    )


def robustness(evidence: Evidence, flown: Flown) -> Measured:
    """R30: what the noise costs, and who crashes from the printed starts."""
    measures = []
    for role in ROLES:
        noisy, quiet = (evidence.seat(role, flown, name).judgements for name in ("fair", "quiet"))
        kept = [
            np.isfinite(seen.settling_time["position"]) | ~np.isfinite(still.settling_time["position"])
            for seen, still in zip(noisy, quiet, strict=True)
        ]
        measures.append(share(f"{role}: trials that settle with noise, or not even without", kept))
        whole = _values(evidence, role, flown, lambda j: ~j.crashed, "printed")
        measures.append(share(f"{role}: trials of the printed starts without a crash", whole))
    return Measured(reading=measures)
