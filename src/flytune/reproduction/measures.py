"""The measures of each claim about flights, as printed and under our reading (`claims.toml` has the definitions)."""

import dataclasses
import math
from collections.abc import Callable, Mapping

import numpy as np

from flytune.evaluation.judge import Judgement
from flytune.evaluation.metrics import POSITION_BAND, YAW_BAND
from flytune.evaluation.statistics import quantile
from flytune.evaluation.table import AXES
from flytune.reproduction.evidence import Evidence, Weights
from flytune.reproduction.study import BEHAVIOURS
from flytune.reproduction.verdict import Measure, median_of_trials, share_of_trials

FASTER = (("acrobatic", "baseline"), ("baseline", "inspection"))
OTHERS = ("baseline", "acrobatic")
PerTrial = Callable[[Judgement], np.ndarray]


@dataclasses.dataclass(frozen=True, kw_only=True)
class ClaimMeasures:
    """The numbers of one claim; a verdict rests on `printed` and `reading`."""

    printed: list[Measure] = dataclasses.field(default_factory=list)  # the claim in the strict sense of its words
    reading: list[Measure] = dataclasses.field(default_factory=list)  # the claim under our reading
    context: list[Measure] = dataclasses.field(default_factory=list)  # what helps to understand the others

    def all(self) -> list[Measure]:
        """Every number, in the order of the tables."""
        return [*self.printed, *self.reading, *self.context]


def _values(
    evidence: Evidence, behaviour: str, weights: Weights, of: PerTrial, setting: str = "fair"
) -> list[np.ndarray]:
    return [of(judgement) for judgement in evidence.response(behaviour, weights, setting).judgements]


def _shares(evidence: Evidence, weights: Weights, what: str, of: PerTrial, setting: str = "fair") -> list[Measure]:
    """One share of trials per behaviour."""
    return [
        share_of_trials(f"{behaviour}: {what}", _values(evidence, behaviour, weights, of, setting))
        for behaviour in BEHAVIOURS
    ]


def _pairs(
    evidence: Evidence, first: str, second: str, weights: Weights, setting: str = "fair"
) -> list[tuple[Judgement, Judgement]]:
    """The judgements of two behaviours, seed by seed."""
    judged = (evidence.response(behaviour, weights, setting).judgements for behaviour in (first, second))
    return list(zip(*judged, strict=True))


def damping(evidence: Evidence, weights: Weights) -> ClaimMeasures:
    """R23: whether responses ever pass their target in x, y or z."""

    def never_past(table: Mapping[str, np.ndarray]) -> np.ndarray:
        return np.all([np.nan_to_num(table[axis], nan=0.0, posinf=np.inf) <= 0 for axis in "xyz"], axis=0)

    what = "trials that never pass the target in x, y, z"
    return ClaimMeasures(
        printed=_shares(evidence, weights, what, lambda judged: never_past(judged.overshoot_raw), "printed"),
        reading=_shares(
            evidence, weights, f"{what} by more than the band", lambda judged: never_past(judged.overshoot)
        ),
    )


def steady_state(evidence: Evidence, weights: Weights) -> ClaimMeasures:
    """R23: how near to the target trials end."""

    def within(judged: Judgement) -> np.ndarray:
        near = [judged.steady_state_error[axis] <= POSITION_BAND for axis in "xyz"]
        return np.all([*near, judged.steady_state_error["yaw"] <= YAW_BAND], axis=0)

    context = []
    for behaviour in BEHAVIOURS:
        position = _values(evidence, behaviour, weights, lambda judged: judged.steady_state_error["position"])
        yaw = _values(evidence, behaviour, weights, lambda judged: np.degrees(judged.steady_state_error["yaw"]))
        context.append(median_of_trials(f"{behaviour}: steady-state error, position", position, "m"))
        context.append(median_of_trials(f"{behaviour}: steady-state error, yaw", yaw, "deg"))
    what = f"trials within {100 * POSITION_BAND:g} cm in x, y, z and {math.degrees(YAW_BAND):g} deg in yaw"
    reading = _shares(evidence, weights, what, within)
    return ClaimMeasures(reading=reading, context=context)


def order(evidence: Evidence, weights: Weights) -> ClaimMeasures:
    """R24: which behaviour settles first, from the same initial state and with the same noise."""

    def rows(setting: str, which: str, feasible: bool) -> list[Measure]:
        return [
            share_of_trials(
                f"{fast} settles before {slow}, {which}",
                [_sooner(a, b, feasible) for a, b in _pairs(evidence, fast, slow, weights, setting)],
            )
            for fast, slow in FASTER
        ]

    context = [
        median_of_trials(
            f"{behaviour}: position settling time",
            _values(evidence, behaviour, weights, lambda judged: judged.settling_time["position"]),
            "s",
        )
        for behaviour in BEHAVIOURS
    ]
    for fast, slow in FASTER:
        pairs = _pairs(evidence, fast, slow, weights)
        times = [[judged.secondary_settling_time["5%"]["position"] for judged in pair] for pair in pairs]
        sooner = [(early < late) & np.isfinite(late) for early, late in times]
        what = f"{fast} settles before {slow} within 5 % of the trial's own distance"
        context.append(share_of_trials(what, sooner, None))
    return ClaimMeasures(
        printed=rows("printed", "all trials of 10 s", feasible=False),
        reading=rows("fair", "feasible trials", feasible=True),
        context=context,
    )


def _sooner(first: Judgement, second: Judgement, feasible: bool) -> np.ndarray:
    """Whether each trial of the first settles before the same trial of the second, which also settles.

    Where one of them never settles there are no two settling times that could be in an order.
    """
    late = second.settling_time["position"]
    sooner = (first.settling_time["position"] < late) & np.isfinite(late)
    return sooner[~first.infeasible & ~second.infeasible] if feasible else sooner


def overshoot(evidence: Evidence, weights: Weights) -> ClaimMeasures:
    """R25: the interquartile range of the overshoot per axis, and that of yaw beside the others."""

    def quartile(values: np.ndarray, level: float) -> float:
        found = quantile(values, level)
        return math.inf if found is None else found

    def rows(kind: str, of: Callable[[Judgement], Mapping[str, np.ndarray]], setting: str) -> list[Measure]:
        found = []
        for behaviour in BEHAVIOURS:
            tables = [of(judged) for judged in evidence.response(behaviour, weights, setting).judgements]
            pooled = {axis: np.concatenate([table[axis] for table in tables]) for axis in AXES}
            low, high = ({axis: quartile(pooled[axis], level) for axis in AXES} for level in (0.25, 0.75))
            for axis in "xyz":
                spread = high[axis] - low[axis] if math.isfinite(high[axis]) else None
                what = f"{behaviour}: interquartile range of the {kind} overshoot in {axis}"
                found.append(Measure(what=what, value=spread, unit="of the step", agrees=spread == 0))
            more = high["yaw"] - max(high[axis] for axis in "xyz")
            what = f"{behaviour}: upper quartile of yaw's {kind} overshoot less the largest of x, y, z"
            value = more if math.isfinite(more) else None
            found.append(Measure(what=what, value=value, unit="of the step", agrees=more > 0))
        return found

    return ClaimMeasures(
        printed=rows("raw", lambda judged: judged.overshoot_raw, "printed"),
        reading=rows("banded", lambda judged: judged.overshoot, "fair"),
    )


def all_settle(evidence: Evidence, weights: Weights) -> ClaimMeasures:
    """R26: how many trials settle at all."""

    def settled(judged: Judgement) -> np.ndarray:
        every = np.all([np.isfinite(judged.settling_time[axis]) for axis in AXES], axis=0)
        return every[~judged.infeasible]

    return ClaimMeasures(reading=_shares(evidence, weights, "feasible trials that settle on all four axes", settled))


def actuation(evidence: Evidence, weights: Weights) -> ClaimMeasures:
    """R29: how hard the motors work, trial by trial, over the same 10 s."""
    kinds = {"RMS": "action_rms", "total variation": "action_total_variation"}
    measures = []
    for other in OTHERS:
        pairs = _pairs(evidence, "inspection", other, weights, "printed")
        for kind, field in kinds.items():
            below = [getattr(a, field) < getattr(b, field) for a, b in pairs]
            measures.append(share_of_trials(f"inspection's {kind} of the action is below {other}'s", below))
    context = []
    for behaviour in BEHAVIOURS:
        speeds = list(evidence.response(behaviour, weights, "printed").rotor_speed)
        context.append(median_of_trials(f"{behaviour}: mean rotor speed", speeds, "rpm"))
    return ClaimMeasures(reading=measures, context=context)


def inspection_first(evidence: Evidence, weights: Weights) -> ClaimMeasures:
    """R29: whether inspection settles before the other two."""
    printed = []
    for other in OTHERS:
        sooner = [_sooner(a, b, True) for a, b in _pairs(evidence, "inspection", other, weights)]
        printed.append(share_of_trials(f"inspection settles before {other}, feasible trials", sooner))
    return ClaimMeasures(printed=printed)


def robustness(evidence: Evidence, weights: Weights) -> ClaimMeasures:
    """R30: how many trials lose their settling to the noise, and how many crash from the printed starts."""
    measures = []
    for behaviour in BEHAVIOURS:
        noisy, quiet = (evidence.response(behaviour, weights, name).judgements for name in ("fair", "noiseless"))
        kept = [
            np.isfinite(seen.settling_time["position"]) | ~np.isfinite(still.settling_time["position"])
            for seen, still in zip(noisy, quiet, strict=True)
        ]
        measures.append(share_of_trials(f"{behaviour}: trials that settle with noise, or not even without", kept))
        whole = _values(evidence, behaviour, weights, lambda judged: ~judged.crashed, "printed")
        measures.append(share_of_trials(f"{behaviour}: trials of the printed starts without a crash", whole))
    return ClaimMeasures(reading=measures)
