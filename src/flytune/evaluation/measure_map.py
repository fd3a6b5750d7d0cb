"""The measurement of a response map: a policy flies at many settings of its dial."""

import dataclasses
from typing import Any

import numpy as np

from flytune.control.policy import Policy
from flytune.control.response_map import ResponseMap, monotone
from flytune.errors import BadInput
from flytune.evaluation.fly import fly
from flytune.evaluation.judge import AXES, Judgement, judge
from flytune.evaluation.statistics import bootstrap_interval, median, quantile
from flytune.task.task import Task

SETTINGS, TRIALS, SEED = 20, 300, 2000  # no training, tuning or evaluation flies these initial conditions
LEAST_SETTLED = 0.95  # of the feasible trials; at a setting with fewer, the map gives no answer


def measure_map(
    policy: Any, task: Task, dial: str | None = None, *, settings: int = SETTINGS, trials: int = TRIALS
) -> ResponseMap:
    """The response map of a policy along one of its dials, measured in flight.

    Args:
        policy: with dials: a `Policy`, or the file of another program.
        task: the task of its training.
        dial: the name of the dial; the first one where None.
        settings: number of values, even in the spacing of the dial.
        trials: flights for each value.

    Raises:
        BadInput: the policy has no such dial.
    """
    name = dial or next(iter(policy.dials), "")
    if name not in policy.dials:
        raise BadInput(f"dial: {name!r} is no dial of this policy. Allowed: {', '.join(policy.dials) or 'none'}.")
    values = policy.dials[name].grid(settings)
    judged = [judge(fly(policy.at({name: value}), task, trials=trials, seed=SEED)) for value in values]
    return ResponseMap(
        dial=name,
        unit=policy.dials[name].unit,
        trials=trials,
        seed=SEED,
        values=values,
        settled=[each.settled("position") for each in judged],
        settling_time=[_interval(each.settling_time["position"]) for each in judged],
        overshoot=[quantile(each.overshoot["position"], 0.9) for each in judged],
        steady_state_error=[_interval(each.steady_state_error["position"]) for each in judged],
        peak_speed=[{"median": median(each.peak_speed), "p95": quantile(each.peak_speed, 0.95)} for each in judged],
        monotone=monotone([_time(each) for each in judged]),
    )


def with_maps(policy: Policy, task: Task) -> Policy:
    """The policy with the response map of each of its dials, measured now."""
    maps = {name: measure_map(policy, task, name).to_dict() for name in policy.dials}
    return dataclasses.replace(policy, maps=maps)


def settled_everywhere(judgement: Judgement) -> float:
    """The share of the feasible trials that settle on every axis."""
    settled = np.all([np.isfinite(judgement.settling_time[axis]) for axis in AXES], axis=0)
    feasible = ~judgement.infeasible
    return float(np.mean(settled[feasible])) if feasible.any() else 0.0


def _time(judgement: Judgement) -> float | None:
    return median(judgement.settling_time["position"]) if settled_everywhere(judgement) >= LEAST_SETTLED else None


def _interval(values: np.ndarray) -> dict[str, float | None]:
    low, high = bootstrap_interval([values], number=500)
    return {"median": median(values), "low": low, "high": high}
