"""Where the paper cannot hold as printed: C1 to C10, each with our own measurement."""

import dataclasses
import math

import numpy as np

from flytune.evaluation.lower_bounds import settling_time_bound
from flytune.evaluation.metrics import POSITION_BAND
from flytune.physics.vehicle import load_vehicle
from flytune.reproduction.curves import column
from flytune.reproduction.evidence import Evidence
from flytune.reproduction.standstill import standstill_distance
from flytune.reproduction.study import ROLES
from flytune.reproduction.verdict import Measure, share
from flytune.training.trainer import find_trainer

DISCOUNTS = (0.99, 0.995, 0.997, 0.998, 0.999)
MOVED = 0.1  # share of the horizontal distance; a trial that covers less stood still


@dataclasses.dataclass(frozen=True, kw_only=True)
class Point:
    """One thing that cannot be as printed, and what we measured of it."""

    item: str
    text: str
    measures: list[Measure]


def points(evidence: Evidence) -> list[Point]:
    """C1 to C10."""
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


def _standing_still(evidence: Evidence) -> Point:
    measures = []
    for role in ROLES:
        task = evidence.tasks[role]
        for discount in DISCOUNTS:
            distance = standstill_distance(task, discount)
            what = f"{role}: distance beyond which standing still earns most, discount {discount}"
            measures.append(Measure(what=what + ("" if distance else " (never, up to 3 m)"), value=distance, unit="m"))
    task = evidence.tasks["inspection"]
    limit = standstill_distance(task, float(task.ppo.discount))
    if limit is not None and hasattr(find_trainer(evidence.study.trainer).settings(task), "discount"):
        for flown in ("last", "average"):
            seat = evidence.seat("inspection", flown)
            stood = [p[d > limit] < MOVED for p, d in zip(seat.progress, seat.distance, strict=True)]
            what = (
                f"inspection, {flown} weights: trials from beyond {limit:.2f} m that cover less than a tenth of the way"
            )
            measures.append(share(what, stood, None))
    text = (
        "The discount decides whether it pays to fly at all: at 0.2 m/s and 0.99 the inspection reward is earned best "
        "by standing still far from the target (an exact dynamic programme on the horizontal distance)."
    )
    return Point(item="C1", text=text, measures=measures)


def _too_far(evidence: Evidence) -> Point:
    measures = []
    for role in ROLES:
        flights = evidence.seat(role, "last", "printed").flights
        distance = np.linalg.norm(flights.position[:, 0] - flights.target_position, axis=-1)
        bound = settling_time_bound(distance, flights.speed_bound)
        for duration in (10.0, float(evidence.tasks[role].duration)):
            late = bound > duration - 0.5
            measures.append(share(f"{role}: starts nobody can settle in {duration:g} s", [late], None))
    text = (
        "At its speed bound inspection needs longer than 10 s for many starts, whoever flies; 20 s are enough for all."
    )
    return Point(item="C2", text=text, measures=measures)


def _already_ended(evidence: Evidence) -> Point:
    flights = evidence.seat("baseline", "last", "printed").flights
    low = flights.position[:, 0, 2] < 0.1
    return Point(
        item="C3",
        text="Starts below 0.1 m are terminated before they begin; the printed starts hold them, the clear do not.",
        measures=[share("printed starts below 0.1 m", [low], None)],
    )


def _too_tilted(evidence: Evidence) -> Point:
    flights = evidence.seat("inspection", "last", "fair").flights
    tilt = np.degrees(
        np.arccos(np.clip(1 - 2 * (flights.attitude[:, 0, 0] ** 2 + flights.attitude[:, 0, 1] ** 2), -1, 1))
    )
    broken = flights.margins["speed"].min(axis=1) < 0
    measures = [share("inspection: trials that break the speed bound", [broken], None)]
    for low, high in ((0, 5), (5, 10), (10, 15), (15, 25)):
        here = (tilt >= low) & (tilt < high)
        measures.append(share(f"of those that start tilted by {low} to {high} deg", [broken[here]], None))
    text = (
        "A start tilted by 15 deg accelerates at 2.6 m/s^2; until it is level again, at no more than 115 deg/s, it may "
        "have passed 0.2 m/s. The first seed is shown, last weights."
    )
    return Point(item="C4", text=text, measures=measures)


def _bands(evidence: Evidence) -> Point:
    measures = []
    for role in ROLES:
        judged = evidence.seat(role, "last").judgements
        primary = [np.isfinite(j.settling_time["position"]) for j in judged]
        measures.append(share(f"{role}: position settles within {POSITION_BAND:g} m", primary, None))
        for band in ("2%", "5%"):
            own = [np.isfinite(j.secondary_settling_time[band]["position"]) for j in judged]
            measures.append(share(f"{role}: position settles within {band} of its own step", own, None))
    text = "2 % of a target of 0 is 0, so a band has to be chosen; how much the choice matters is shown here."
    return Point(item="C5", text=text, measures=measures)


def _mean_rotor_speed(evidence: Evidence) -> Point:
    hover = float(evidence.tasks["baseline"].vehicle.hover_rotor_speed_rpm)
    measures = [Measure(what="hover speed", value=hover, unit="rpm")]
    for role in ROLES:
        speeds = evidence.seat(role, "last", "printed").rotor_speed
        measures.append(
            Measure(
                what=f"{role}: mean rotor speed of a trial less the hover speed, mean [least, most] of all trials",
                value=float(speeds.mean() - hover),
                low=float(speeds.min() - hover),
                high=float(speeds.max() - hover),
                unit="rpm",
            )
        )
    text = "The mean rotor speed of whoever hovers is the hover speed; RMS and total variation tell controllers apart."
    return Point(item="C6", text=text, measures=measures)


def _thrust() -> Point:
    measures = [
        Measure(what=f"thrust-to-weight ratio of {name}", value=float(load_vehicle(name).thrust_to_weight))
        for name in ("crazyflie", "crazyflie-measured")
    ]
    return Point(item="C7", text="The actions of R9 ask for more thrust than a real Crazyflie has.", measures=measures)


def _contradiction(evidence: Evidence) -> Point:
    return Point(
        item="C8",
        text="R29 (inspection settles faster) contradicts R24 (it settles last): one of the two must fail.",
        measures=[],
    )


def _never_binds(evidence: Evidence) -> Point:
    measures = []
    for role in ("baseline", "acrobatic"):
        ends = [sum(row["terminations"].get("attitude", 0) for row in curve) for curve in evidence.curves[role]]
        episodes = [float(np.nansum(column(curve, "episodes"))) for curve in evidence.curves[role]]
        what = f"{role}: episodes ended by an attitude error above pi, of {sum(episodes):,.0f}"
        measures.append(Measure(what=what, value=float(sum(ends)), unit="episodes"))
    return Point(item="C9", text="An angle in [0, pi] never exceeds pi.", measures=measures)


def _presets(evidence: Evidence) -> Point:
    measures = []
    for role in ROLES:
        reward = evidence.tasks[role].reward
        measures.append(
            Measure(what=f"{role}: survival reward", value=float(getattr(reward["survival"], "reward", 0.0)))
        )
        wide = float(getattr(reward["horizontal"], "wide", math.nan))
        measures.append(Measure(what=f"{role}: wide horizontal delta", value=wide, unit="1/m^2"))
        measures.append(
            Measure(what=f"{role}: distance at which its pull is strongest", value=1 / math.sqrt(2 * wide), unit="m")
        )
    text = (
        "The 0.1 of H1 is in no preset; inspection, the slowest, has the delta of acrobatic, the fastest, against "
        "H3; a larger delta also reaches less far."
    )
    return Point(item="C10", text=text, measures=measures)
