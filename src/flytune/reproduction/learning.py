"""Learning curves of a study, and what is measured for each claim about learning: R27 and R28."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from flytune.reproduction.evidence import Evidence, Weights
from flytune.reproduction.measures import ClaimMeasures
from flytune.reproduction.study import BEHAVIOURS
from flytune.reproduction.verdict import Measure
from flytune.task.task import Task

Rows = Sequence[Mapping[str, Any]]
SMOOTH = 0.1  # of a training: the share of its updates a smoothed reward is the mean of
SURVIVES = 0.9  # of the horizon
SURVIVAL = 700e3  # steps (R27)
ONE_SEED = "one seed has no variance over seeds"
NO_EPISODE = "no episode ended in the last tenth of a training, so that it has no last reward"


def column(rows: Rows, name: str) -> np.ndarray:
    """One number per update, NaN where a row has none."""
    return np.array([np.nan if row.get(name) is None else float(row[name]) for row in rows])


def smoothed_reward(rows: Rows) -> np.ndarray:
    """Mean episode reward over the tenth of the training that ends with each update; over fewer at the beginning."""
    rewards = column(rows, "episode_reward")
    width = max(round(SMOOTH * len(rewards)), 1)
    known = np.isfinite(rewards)
    total, count = (np.concatenate([[0.0], np.cumsum(part)]) for part in (np.where(known, rewards, 0.0), known))
    end = np.arange(1, len(rewards) + 1)
    begin = np.maximum(end - width, 0)
    number = count[end] - count[begin]
    return np.where(number > 0, (total[end] - total[begin]) / np.maximum(number, 1), np.nan)


def reward_at(rows: Rows, share: float) -> float:
    """The smoothed episode reward at a share of the training, 0 to 1."""
    return float(smoothed_reward(rows)[max(round(share * len(rows)), 1) - 1])


def steps_to_survive(rows: Rows, task: Task) -> float | None:
    """Environment steps until episodes first last nine tenths of the horizon on average; None if they never do."""
    long_enough = np.flatnonzero(column(rows, "episode_length") >= SURVIVES * task.horizon)
    return float(rows[long_enough[0]]["steps"]) if long_enough.size else None


def steps_to_share(rows: Rows, share: float) -> float:
    """Environment steps until the smoothed episode reward first reaches a share of its final value."""
    course = smoothed_reward(rows)
    return float(rows[int(np.argmax(course >= share * course[-1]))]["steps"])


def variance(evidence: Evidence, weights: Weights) -> ClaimMeasures:
    """R27: the spread of the last reward over seeds."""
    rows = []
    for behaviour in BEHAVIOURS:
        final = np.array([reward_at(curve, 1.0) for curve in evidence.curves[behaviour]])
        what = f"{behaviour}: standard deviation over seeds of the last episode reward, over its mean"
        missing = NO_EPISODE if np.any(np.isnan(final)) else ONE_SEED if final.size < 2 else ""
        if missing:
            rows.append(Measure(what=what, value=None, unit="share", missing=missing))
            continue
        spread = float(np.std(final, ddof=1) / abs(np.mean(final)))
        rows.append(Measure(what=what, value=spread, unit="share", agrees=spread <= 0.05))
    return ClaimMeasures(reading=rows)


def survival(evidence: Evidence, weights: Weights) -> ClaimMeasures:
    """R27: how many steps it takes until episodes last, and whether the reward still rises then."""
    rows = {behaviour: _survival(evidence, behaviour) for behaviour in BEHAVIOURS}
    inspection = rows.pop("inspection")
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
    return ClaimMeasures(reading=[inspection, more], context=list(rows.values()))


def _survival(evidence: Evidence, behaviour: str) -> Measure:
    found = [steps_to_survive(curve, evidence.tasks[behaviour]) for curve in evidence.curves[behaviour]]
    known = [steps for steps in found if steps is not None]
    what = (
        f"{behaviour}: steps until episodes last nine tenths of the horizon, median [least, most] of the "
        f"{len(known)} of {len(found)} seeds that get there"
    )
    agrees = len(known) == len(found) and all(SURVIVAL / 2 <= steps <= 2 * SURVIVAL for steps in known)
    return _median_of_seeds(what, known, "steps", agrees)


def efficiency(evidence: Evidence, weights: Weights) -> ClaimMeasures:
    """R28: how soon each behaviour earns nearly all it ever earns, and how much it still gains at the end."""
    ends = [reward_at(curve, at) for curves in evidence.curves.values() for curve in curves for at in (0.8, 1.0)]
    if np.any(np.isnan(ends)):
        return ClaimMeasures(reading=[Measure(what="episode reward at the end", value=None, missing=NO_EPISODE)])
    needed = {
        behaviour: [steps_to_share(curve, 0.95) for curve in evidence.curves[behaviour]] for behaviour in BEHAVIOURS
    }
    medians = [float(np.median(steps)) for steps in needed.values()]
    ratio = max(medians) / min(medians)
    what = "steps to 95 % of the final reward, slowest over quickest behaviour"
    rows = [Measure(what=what, value=ratio, agrees=ratio <= 2)]
    for behaviour in BEHAVIOURS:
        gains = [abs(reward_at(curve, 1.0) / reward_at(curve, 0.8) - 1) for curve in evidence.curves[behaviour]]
        what = f"{behaviour}: change of the reward over the last fifth, median [least, most] over seeds"
        rows.append(_median_of_seeds(what, gains, "share", float(np.median(gains)) <= 0.02))
    what = "steps to 95 % of the final reward, median [least, most] over seeds"
    context = [_median_of_seeds(f"{behaviour}: {what}", steps, "steps") for behaviour, steps in needed.items()]
    return ClaimMeasures(reading=rows, context=context)


def _median_of_seeds(what: str, values: Sequence[float], unit: str, agrees: bool | None = None) -> Measure:
    """The median over seeds between the least and the greatest of them."""
    value = float(np.median(values)) if values else None
    low, high = min(values, default=None), max(values, default=None)
    return Measure(what=what, value=value, low=low, high=high, unit=unit, agrees=agrees)
