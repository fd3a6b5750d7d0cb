"""What is measured for each claim about learning: R27 and R28."""

import numpy as np

from flytune.reproduction.curves import reward_at, smoothed_reward, steps_to_share, steps_to_survive
from flytune.reproduction.evidence import Evidence, Flown
from flytune.reproduction.measures import Measured
from flytune.reproduction.study import ROLES
from flytune.reproduction.verdict import Measure

SURVIVAL = 700e3  # steps (R27)


def variance(evidence: Evidence, flown: Flown) -> Measured:
    """R27: the spread of the last reward over seeds."""
    rows = []
    for role in ROLES:
        final = np.array([reward_at(curve, 1.0) for curve in evidence.curves[role]])
        spread = float(np.std(final, ddof=1) / abs(np.mean(final))) if final.size > 1 else None
        what = f"{role}: standard deviation over seeds of the last episode reward, over its mean"
        rows.append(Measure(what=what, value=spread, unit="share", agrees=spread is not None and spread <= 0.05))
    return Measured(reading=rows)


def survival(evidence: Evidence, flown: Flown) -> Measured:
    """R27: how many steps it takes until episodes last, and whether the reward still rises then."""
    rows = {role: _survival(evidence, role) for role in ROLES}
    rises = []
    for curve in evidence.curves["inspection"]:
        steps = steps_to_survive(curve, evidence.tasks["inspection"])
        there = [row["steps"] for row in curve]
        rises.append(steps is not None and reward_at(curve, 1.0) > smoothed_reward(curve)[there.index(steps)])
    more = Measure(
        what="inspection: seeds that earn more at the end than when they first survived",
        value=float(np.mean(rises)),
        unit="share",
        agrees=all(rises),
    )
    return Measured(reading=[rows["inspection"], more], aside=[rows[role] for role in ROLES if role != "inspection"])


def _survival(evidence: Evidence, role: str) -> Measure:
    found = [steps_to_survive(curve, evidence.tasks[role]) for curve in evidence.curves[role]]
    known = [steps for steps in found if steps is not None]
    return Measure(
        what=f"{role}: steps until episodes last nine tenths of the horizon, median [least, most] of the "
        f"{len(known)} of {len(found)} seeds that get there",
        value=float(np.median(known)) if known else None,
        low=min(known, default=None),
        high=max(known, default=None),
        unit="steps",
        agrees=len(known) == len(found) and all(SURVIVAL / 2 <= steps <= 2 * SURVIVAL for steps in known),
    )


def efficiency(evidence: Evidence, flown: Flown) -> Measured:
    """R28: how soon each behaviour earns nearly all it ever earns, and how much it still gains at the end."""
    needed = {role: [steps_to_share(curve, 0.95) for curve in evidence.curves[role]] for role in ROLES}
    middles = {role: float(np.median(steps)) for role, steps in needed.items()}
    ratio = max(middles.values()) / min(middles.values())
    rows = [
        Measure(
            what="steps to 95 % of the final reward, slowest over quickest behaviour", value=ratio, agrees=ratio <= 2
        )
    ]
    for role in ROLES:
        gains = [abs(reward_at(curve, 1.0) / reward_at(curve, 0.8) - 1) for curve in evidence.curves[role]]
        gain = float(np.median(gains))
        what = f"{role}: change of the reward over the last fifth, median [least, most] over seeds"
        rows.append(Measure(what=what, value=gain, low=min(gains), high=max(gains), unit="share", agrees=gain <= 0.02))
    aside = [
        Measure(
            what=f"{role}: steps to 95 % of the final reward, median [least, most] over seeds",
            value=middles[role],
            low=min(needed[role]),
            high=max(needed[role]),
            unit="steps",
        )
        for role in ROLES
    ]
    return Measured(reading=rows, aside=aside)
