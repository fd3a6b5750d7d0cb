"""Where the paper is inconsistent as printed: C1 to C10, each with our own measurement."""

import dataclasses
import math

import numpy as np

from flytune.evaluation.lower_bounds import settling_time_bound
from flytune.evaluation.metrics import POSITION_BAND
from flytune.physics.vehicle import load_vehicle
from flytune.reproduction.evidence import Evidence
from flytune.reproduction.learning import column
from flytune.reproduction.standstill import standstill_distance
from flytune.reproduction.study import BEHAVIOURS
from flytune.reproduction.verdict import Measure, share_of_trials
from flytune.training.trainer import find_trainer

DISCOUNTS = (0.99, 0.995, 0.997, 0.998, 0.999)
MOVED = 0.1  # share of the horizontal distance; a trial that covers less stood still


@dataclasses.dataclass(frozen=True, kw_only=True)
class Inconsistency:
    """One thing that cannot be true as printed, and what we measured of it."""

    item: str
    text: str
    measures: list[Measure]


def find_inconsistencies(evidence: Evidence) -> list[Inconsistency]:
    """C1 to C10, in this order."""
    return [
        _standing_still(evidence),
        _too_far(evidence),
        _already_ended(evidence),
        _too_tilted(evidence),
        _bands(evidence),
        _mean_rotor_speed(evidence),
        _thrust(),
        _contradiction(evidence),
        _never_binds(evidence),
        _presets(evidence),
    ]


def _standing_still(evidence: Evidence) -> Inconsistency:
    measures = []
    for behaviour in BEHAVIOURS:
        task = evidence.tasks[behaviour]
        for discount in DISCOUNTS:
            distance = standstill_distance(task, discount)
            what = f"{behaviour}: distance beyond which standing still earns most, discount {discount}"
            measures.append(Measure(what=what + ("" if distance else " (never, up to 3 m)"), value=distance, unit="m"))
    task = evidence.tasks["inspection"]
    limit = standstill_distance(task, float(task.ppo.discount))
    if limit is not None and hasattr(find_trainer(evidence.study.trainer).settings(task), "discount"):
        for weights in ("last", "averaged"):
            response = evidence.response("inspection", weights)
            stood = [p[d > limit] < MOVED for p, d in zip(response.progress, response.distance, strict=True)]
            what = f"inspection, {weights} weights: trials from beyond {limit:.2f} m"
            measures.append(share_of_trials(f"{what} that cover less than a tenth of the way", stood, None))
    text = (
        "The discount decides whether flying to the target earns more than standing still. At 0.2 m/s and a discount "
        "of 0.99 the inspection reward is largest for standing still far from the target (an exact dynamic programme "
        "on the horizontal distance)."
    )
    return Inconsistency(item="C1", text=text, measures=measures)


def _too_far(evidence: Evidence) -> Inconsistency:
    measures = []
    for behaviour in BEHAVIOURS:
        flights = evidence.response(behaviour, "last", "printed").flights
        distance = np.linalg.norm(flights.position[:, 0] - flights.target_position, axis=-1)
        bound = settling_time_bound(distance, flights.speed_bound)
        for duration in (10.0, float(evidence.tasks[behaviour].duration)):
            late = bound > duration - 0.5
            measures.append(
                share_of_trials(f"{behaviour}: starts that no controller can settle in {duration:g} s", [late], None)
            )
    text = (
        "At its speed bound, inspection needs longer than 10 s from many starts, with any controller. 20 s are enough "
        "for all."
    )
    return Inconsistency(item="C2", text=text, measures=measures)


def _already_ended(evidence: Evidence) -> Inconsistency:
    flights = evidence.response("baseline", "last", "printed").flights
    low = flights.position[:, 0, 2] < 0.1
    return Inconsistency(
        item="C3",
        text="Trials that start below 0.1 m are terminated at once. The printed starts contain such trials, the clear "
        "starts do not.",
        measures=[share_of_trials("printed starts below 0.1 m", [low], None)],
    )


def _too_tilted(evidence: Evidence) -> Inconsistency:
    flights = evidence.response("inspection", "last", "fair").flights
    tilt = np.degrees(
        np.arccos(np.clip(1 - 2 * (flights.attitude[:, 0, 0] ** 2 + flights.attitude[:, 0, 1] ** 2), -1, 1))
    )
    broken = flights.margins["speed"].min(axis=1) < 0
    measures = [share_of_trials("inspection: trials that break the speed bound", [broken], None)]
    for low, high in ((0, 5), (5, 10), (10, 15), (15, 25)):
        here = (tilt >= low) & (tilt < high)
        measures.append(share_of_trials(f"of those that start tilted by {low} to {high} deg", [broken[here]], None))
    text = (
        "A vehicle that starts tilted by 15 deg accelerates at 2.6 m/s^2. It may exceed 0.2 m/s before it is level "
        "again, since it may turn at 115 deg/s at most. The numbers are of the first seed and the last weights."
    )
    return Inconsistency(item="C4", text=text, measures=measures)


def _bands(evidence: Evidence) -> Inconsistency:
    measures = []
    for behaviour in BEHAVIOURS:
        judged = evidence.response(behaviour, "last").judgements
        primary = [np.isfinite(j.settling_time["position"]) for j in judged]
        measures.append(share_of_trials(f"{behaviour}: position settles within {POSITION_BAND:g} m", primary, None))
        for band in ("2%", "5%"):
            own = [np.isfinite(j.secondary_settling_time[band]["position"]) for j in judged]
            measures.append(share_of_trials(f"{behaviour}: position settles within {band} of its own step", own, None))
    text = "2 % of a target of 0 is 0, so a band has to be chosen. The shares show how much the choice matters."
    return Inconsistency(item="C5", text=text, measures=measures)


def _mean_rotor_speed(evidence: Evidence) -> Inconsistency:
    hover = float(evidence.tasks["baseline"].vehicle.hover_rotor_speed_rpm)
    measures = [Measure(what="hover speed", value=hover, unit="rpm")]
    for behaviour in BEHAVIOURS:
        speeds = evidence.response(behaviour, "last", "printed").rotor_speed
        measures.append(
            Measure(
                what=f"{behaviour}: mean rotor speed of a trial less the hover speed, mean [least, most] of all trials",
                value=float(speeds.mean() - hover),
                low=float(speeds.min() - hover),
                high=float(speeds.max() - hover),
                unit="rpm",
            )
        )
    text = (
        "The mean rotor speed of every controller that hovers is the hover speed. RMS and total variation of the "
        "action tell controllers apart."
    )
    return Inconsistency(item="C6", text=text, measures=measures)


def _thrust() -> Inconsistency:
    measures = [
        Measure(what=f"thrust-to-weight ratio of {name}", value=float(load_vehicle(name).thrust_to_weight))
        for name in ("crazyflie", "crazyflie-measured")
    ]
    return Inconsistency(
        item="C7", text="The actions of R9 ask for more thrust than a real Crazyflie has.", measures=measures
    )


def _contradiction(evidence: Evidence) -> Inconsistency:
    return Inconsistency(
        item="C8",
        text="R29 (inspection settles faster) contradicts R24 (inspection settles last). One of the two must fail.",
        measures=[],
    )


def _never_binds(evidence: Evidence) -> Inconsistency:
    measures = []
    for behaviour in ("baseline", "acrobatic"):
        ends = [sum(row["terminations"].get("attitude", 0) for row in curve) for curve in evidence.curves[behaviour]]
        episodes = [float(np.nansum(column(curve, "episodes"))) for curve in evidence.curves[behaviour]]
        what = f"{behaviour}: episodes ended by an attitude error above pi, of {sum(episodes):,.0f}"
        measures.append(Measure(what=what, value=float(sum(ends)), unit="episodes"))
    return Inconsistency(item="C9", text="An angle in [0, pi] never exceeds pi.", measures=measures)


def _presets(evidence: Evidence) -> Inconsistency:
    measures = []
    for behaviour in BEHAVIOURS:
        reward = evidence.tasks[behaviour].reward
        measures.append(
            Measure(what=f"{behaviour}: survival reward", value=float(getattr(reward["survival"], "reward", 0.0)))
        )
        wide = float(getattr(reward["horizontal"], "wide", math.nan))
        measures.append(Measure(what=f"{behaviour}: wide horizontal delta", value=wide, unit="1/m^2"))
        measures.append(
            Measure(
                what=f"{behaviour}: distance at which its pull is strongest", value=1 / math.sqrt(2 * wide), unit="m"
            )
        )
    text = (
        "No preset has the 0.1 of H1. Inspection, the slowest, has the delta of acrobatic, the fastest, which "
        "contradicts H3. A larger delta also has a shorter reach."
    )
    return Inconsistency(item="C10", text=text, measures=measures)
