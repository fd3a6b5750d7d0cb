"""Where the paper is inconsistent as printed: C1 to C10 (`inconsistencies.toml`), each with our own measurement."""

import dataclasses
import math
import tomllib
from collections.abc import Callable
from importlib import resources

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
    file = resources.files("flytune.reproduction") / "inconsistencies.toml"
    texts = tomllib.loads(file.read_text(encoding="utf-8"))
    return [
        Inconsistency(item=item, text=text, measures=MEASURES[item](evidence) if item in MEASURES else [])
        for item, text in texts.items()
    ]


def _standing_still(evidence: Evidence) -> list[Measure]:
    measures = []
    for behaviour in BEHAVIOURS:
        for discount in DISCOUNTS:
            distance = standstill_distance(evidence.tasks[behaviour], discount)
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
    return measures


def _too_far(evidence: Evidence) -> list[Measure]:
    measures = []
    for behaviour in BEHAVIOURS:
        flights = evidence.response(behaviour, "last", "printed").flights
        distance = np.linalg.norm(flights.position[:, 0] - flights.target_position, axis=-1)
        bound = settling_time_bound(distance, flights.speed_bound)
        for duration in (10.0, float(evidence.tasks[behaviour].duration)):
            what = f"{behaviour}: starts that no controller can settle in {duration:g} s"
            measures.append(share_of_trials(what, [bound > duration - 0.5], None))
    return measures


def _already_ended(evidence: Evidence) -> list[Measure]:
    height = evidence.response("baseline", "last", "printed").flights.position[:, 0, 2]
    return [share_of_trials("printed starts below 0.1 m", [height < 0.1], None)]


def _too_tilted(evidence: Evidence) -> list[Measure]:
    flights = evidence.response("inspection", "last", "fair").flights
    tilt = np.degrees(
        np.arccos(np.clip(1 - 2 * (flights.attitude[:, 0, 0] ** 2 + flights.attitude[:, 0, 1] ** 2), -1, 1))
    )
    broken = flights.margins["speed"].min(axis=1) < 0
    measures = [share_of_trials("inspection: trials that break the speed bound", [broken], None)]
    for low, high in ((0, 5), (5, 10), (10, 15), (15, 25)):
        here = (tilt >= low) & (tilt < high)
        measures.append(share_of_trials(f"of those that start tilted by {low} to {high} deg", [broken[here]], None))
    return measures


def _bands(evidence: Evidence) -> list[Measure]:
    measures = []
    for behaviour in BEHAVIOURS:
        judged = evidence.response(behaviour, "last").judgements
        primary = [np.isfinite(j.settling_time["position"]) for j in judged]
        measures.append(share_of_trials(f"{behaviour}: position settles within {POSITION_BAND:g} m", primary, None))
        for band in ("2%", "5%"):
            own = [np.isfinite(j.secondary_settling_time[band]["position"]) for j in judged]
            measures.append(share_of_trials(f"{behaviour}: position settles within {band} of its own step", own, None))
    return measures


def _mean_rotor_speed(evidence: Evidence) -> list[Measure]:
    hover = float(evidence.tasks["baseline"].vehicle.hover_rotor_speed_rpm)
    measures = [Measure(what="hover speed", value=hover, unit="rpm")]
    for behaviour in BEHAVIOURS:
        speeds = evidence.response(behaviour, "last", "printed").rotor_speed
        mean, low, high = (float(speed - hover) for speed in (speeds.mean(), speeds.min(), speeds.max()))
        what = f"{behaviour}: mean rotor speed of a trial less the hover speed, mean [least, most] of all trials"
        measures.append(Measure(what=what, value=mean, low=low, high=high, unit="rpm"))
    return measures


def _thrust(evidence: Evidence) -> list[Measure]:
    return [
        Measure(what=f"thrust-to-weight ratio of {name}", value=float(load_vehicle(name).full_thrust_to_weight))
        for name in ("crazyflie", "crazyflie-measured")
    ]


def _never_binds(evidence: Evidence) -> list[Measure]:
    measures = []
    for behaviour in ("baseline", "acrobatic"):
        ends = [sum(row["terminations"].get("attitude", 0) for row in curve) for curve in evidence.curves[behaviour]]
        episodes = [float(np.nansum(column(curve, "episodes"))) for curve in evidence.curves[behaviour]]
        what = f"{behaviour}: episodes ended by an attitude error above pi, of {sum(episodes):,.0f}"
        measures.append(Measure(what=what, value=float(sum(ends)), unit="episodes"))
    return measures


def _presets(evidence: Evidence) -> list[Measure]:
    measures = []
    for behaviour in BEHAVIOURS:
        reward = evidence.tasks[behaviour].reward
        survival = float(getattr(reward["survival"], "reward", 0.0))
        wide = float(getattr(reward["horizontal"], "wide", math.nan))
        reach = 1 / math.sqrt(2 * wide)
        measures += [
            Measure(what=f"{behaviour}: survival reward", value=survival),
            Measure(what=f"{behaviour}: wide horizontal delta", value=wide, unit="1/m^2"),
            Measure(what=f"{behaviour}: distance at which its pull is strongest", value=reach, unit="m"),
        ]
    return measures


MEASURES: dict[str, Callable[[Evidence], list[Measure]]] = {
    "C1": _standing_still,
    "C2": _too_far,
    "C3": _already_ended,
    "C4": _too_tilted,
    "C5": _bands,
    "C6": _mean_rotor_speed,
    "C7": _thrust,
    "C9": _never_binds,  # C8 is a contradiction between two claims: nothing to measure
    "C10": _presets,
}
