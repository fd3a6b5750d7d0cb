"""The texts of a page on flights and tasks, as plain values that the templates write."""

import re
from collections.abc import Sequence
from typing import Any

import numpy as np

from flytune.config import document, nested
from flytune.evaluation.evaluate import Evaluation
from flytune.evaluation.judge import AXES, Judgement
from flytune.evaluation.statistics import median
from flytune.evaluation.table import met_words
from flytune.report.style import listed
from flytune.tables import NULL, Column, Table, number
from flytune.task.files import write_task
from flytune.task.task import Task

COMMENT = re.compile(r"""^((?:"(?:\\.|[^"\\])*"|'[^']*'|[^"'#])*)(#.*)$""")  # a # inside quotes begins no comment


def summary(judgement: Judgement) -> dict[str, Any]:
    """The parts of one sentence: trials that settle on all axes, and the slowest axis or the axes that fail."""
    settled = np.logical_and.reduce([np.isfinite(judgement.settling_time[axis]) for axis in AXES])
    medians = {axis: median(judgement.settling_time[axis]) for axis in AXES}
    known = {axis: time for axis, time in medians.items() if time is not None}
    slowest = max(known, key=known.__getitem__, default="")
    return {
        "settled": np.count_nonzero(settled),
        "late": listed([axis for axis in AXES if axis not in known]),
        "slowest": slowest,
        "median": number(known.get(slowest), 2),
    }


def facts(judgement: Judgement, speed_bound: float | None) -> dict[str, str]:
    """The results that belong to no single axis, as terms and their values: failures, bounds, speed, action."""
    judged = judgement.to_dict()
    crossed = [f"{name} {count}" for name, count in judged["violations"].items()]
    peak, action = judged["peak_speed"], judged["action"]
    bound = "no bound" if speed_bound is None else f"bound {speed_bound:g} m/s"
    small = ", ".join(f"{axis} {judged['axes'][axis]['small_steps']}" for axis in AXES)
    return {
        "crashed": f"{judged['crashed']} of {judgement.trials} trials",
        "infeasible": f"{judged['infeasible']} of {judgement.trials} trials (no controller could settle these in time)",
        "trials that crossed a bound": ", ".join(crossed) or "none, the task has no bound",
        "peak speed": f"{number(peak['median'], 2)} m/s median, {number(peak['p95'], 2)} m/s p95 ({bound})",
        "efficiency": f"{number(judged['efficiency']['median'], 2)} median (physical bound / settling time)",
        "action": f"{number(action['rms'], 3)} RMS, changes by {number(action['total_variation'], 4)} per step",
        "step too small for overshoot": f"{small} trials",
        "flown": f"{judgement.trials} trials of {judgement.duration:g} s, starts {judgement.initial_conditions}, "
        f"seed {judgement.seed}, vehicle {judgement.vehicle}"
        + (f" (made for {judgement.made_for})" if judgement.made_for else "")
        + met_words(judgement.changes)
        + f", world {judgement.simulator}",
    }


def task_differences(evaluations: Sequence[Evaluation]) -> Table | None:
    """The fields in which the tasks of several controllers differ, one column per controller; None where none does."""
    plain = [document.plain(evaluation.task) for evaluation in evaluations]
    flat = [{path: str(value) for path, value in nested.leaves(task, skip=["sources"])} for task in plain]
    paths = dict.fromkeys(path for leaves in flat for path in leaves)
    differing = [path for path in paths if len({leaves.get(path) for leaves in flat}) > 1]
    rows = [(path, *(leaves.get(path, NULL) for leaves in flat)) for path in differing]
    return Table.plain(["field", *(Column(one.name) for one in evaluations)], rows) if rows else None


def task_lines(task: Task) -> list[tuple[str, str]]:
    """The lines of the task file, each as its value and its comment (units, allowed ranges, sources)."""
    found = [(COMMENT.match(line), line) for line in write_task(task).splitlines()]
    return [(match[1], match[2]) if match else (line, "") for match, line in found]
