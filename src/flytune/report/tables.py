"""Tables and texts of the report as HTML; every text that somebody typed is escaped here."""

import math
import re
from collections.abc import Mapping, Sequence
from html import escape

import numpy as np

from flytune.config import document, nested
from flytune.evaluation.judge import AXES, CHANNELS, Judgement
from flytune.report.style import listed
from flytune.task.task import Task, write_task

Row = Sequence[str]
DASH = "\N{EN DASH}"
COMMENT = re.compile(r"""^((?:"(?:\\.|[^"\\])*"|'[^']*'|[^"'#])*)(#.*)$""")  # a # inside quotes begins no comment


def verdict(judgement: Judgement) -> str:
    """The flights in one sentence."""
    settled = np.logical_and.reduce([np.isfinite(judgement.settling_time[axis]) for axis in AXES])
    medians = {axis: judgement.to_dict()["axes"][axis]["settling_time"]["median"] for axis in AXES}
    reached = {axis: value for axis, value in medians.items() if value is not None}
    text = f"<strong>{np.count_nonzero(settled)} of {judgement.trials}</strong> trials settle on all four axes"
    if len(reached) == len(AXES):
        slowest = max(reached, key=reached.__getitem__)
        median = f"<strong>{reached[slowest]:.2f}&nbsp;s</strong>"
        text += f"; the slowest axis is {slowest}, with a median settling time of {median}"
    else:
        late = listed([axis for axis in AXES if axis not in reached])
        text += f"; fewer than half settle on {late}"
    return text + "."


def response_table(judgement: Judgement) -> str:
    """The response table: one row per axis and one for the distance."""
    judged = judgement.to_dict()
    judged = {**judged["axes"], "position": judged["position"]}
    head = (
        '<tr><th rowspan="2"></th><th rowspan="2">settled</th><th colspan="2">settling time [s]</th>'
        '<th>rise [s]</th><th colspan="2">overshoot [%]</th><th colspan="3">steady-state error</th></tr>'
        "<tr><th>median</th><th>p95</th><th>median</th><th>median</th><th>p95</th>"
        "<th>median</th><th>p95</th><th>unit</th></tr>"
    )
    rows = []
    for channel in CHANNELS:
        scale, unit, digits = (math.degrees(1), "deg", 2) if channel == "yaw" else (1e3, "mm", 1)
        row = judged[channel]
        over, error, rise = row["overshoot"], row["steady_state_error"], row.get("rise_time")
        rows.append(
            (
                channel,
                f"{row['settled']}/{judgement.trials}",
                number(row["settling_time"]["median"], 2),
                number(row["settling_time"]["p95"], 2),
                number(rise["median"], 2) if rise else "",
                number(over["median"], 1, 100.0),
                number(over["p95"], 1, 100.0),
                number(error["median"], digits, scale),
                number(error["p95"], digits, scale),
                unit,
            )
        )
    return table(head, rows)


def facts(judgement: Judgement, speed_bound: float | None) -> str:
    """What does not belong to one axis, as a list of terms: failures, bounds, speed, action."""
    judged = judgement.to_dict()
    crossed = [f"{name} {count}" for name, count in judged["violations"].items()]
    peak, action = judged["peak_speed"], judged["action"]
    bound = "no bound" if speed_bound is None else f"bound {speed_bound:g} m/s"
    small = ", ".join(f"{axis} {judged['axes'][axis]['small_steps']}" for axis in AXES)
    return definitions(
        {
            "crashed": f"{judged['crashed']} of {judgement.trials} trials",
            "infeasible": f"{judged['infeasible']} of {judgement.trials} trials (nobody could settle these in time)",
            "trials that crossed a bound": ", ".join(crossed) or "none, the task has no bound",
            "peak speed": f"{number(peak['median'], 2)} m/s median, {number(peak['p95'], 2)} m/s p95 ({bound})",
            "efficiency": f"{number(judged['efficiency']['median'], 2)} median (physical bound / settling time)",
            "action": f"{number(action['rms'], 3)} RMS, changes by {number(action['total_variation'], 4)} a step",
            "too small a step for overshoot": f"{small} trials",
            "flown": f"{judgement.trials} trials of {judgement.duration:g} s, starts {judgement.initial_conditions}, "
            f"seed {judgement.seed}, vehicle {judgement.vehicle}, world {judgement.simulator}",
        }
    )


def comparison_table(judged: Sequence[tuple[str, str, Judgement]]) -> str:
    """One row per policy (anchor, name, judgement): settled trials, settling time per axis, error, failures."""
    head = (
        '<tr><th rowspan="2">policy</th><th rowspan="2">task</th><th rowspan="2">trials</th>'
        '<th colspan="4">settled</th>'
        '<th colspan="4">settling time [s], median</th><th colspan="2">error, median</th>'
        '<th rowspan="2">peak speed<br>[m/s]</th><th rowspan="2">action<br>RMS</th><th rowspan="2">crashed</th></tr>'
        "<tr>"
        + "".join(f"<th>{axis}</th>" for axis in AXES) * 2
        + "<th>position<br>[mm]</th><th>yaw<br>[deg]</th></tr>"
    )
    rows = []
    for anchor, name, judgement in judged:
        told = judgement.to_dict()
        axes = told["axes"]
        rows.append(
            (
                f'<a href="#{anchor}">{escape(name)}</a>',
                escape(judgement.task),
                str(judgement.trials),
                *(str(axes[axis]["settled"]) for axis in AXES),
                *(number(axes[axis]["settling_time"]["median"], 2) for axis in AXES),
                number(told["position"]["steady_state_error"]["median"], 1, 1e3),
                number(axes["yaw"]["steady_state_error"]["median"], 2, math.degrees(1)),
                number(told["peak_speed"]["median"], 2),
                number(told["action"]["rms"], 3),
                str(told["crashed"]),
            )
        )
    return table(head, rows, "dense")


def differences_table(tasks: Sequence[tuple[str, Task]]) -> str:
    """The fields in which the tasks of several policies differ, one column per policy; a sentence where none does."""
    flat = [
        {path: str(value) for path, value in nested.leaves(document.plain(task), skip=["sources"])} for _, task in tasks
    ]
    paths = dict.fromkeys(path for leaves in flat for path in leaves)
    differing = [path for path in paths if len({leaves.get(path) for leaves in flat}) > 1]
    if not differing:
        return "<p>All were given the same task, number by number.</p>"
    head = "<tr><th>field</th>" + "".join(f"<th>{escape(name)}</th>" for name, _ in tasks) + "</tr>"
    rows = [
        (f"<code>{escape(path)}</code>", *(escape(leaves.get(path, DASH)) for leaves in flat)) for path in differing
    ]
    return table(head, rows)


def task_listing(task: Task) -> str:
    """The task file, its comments (units, allowed ranges, sources) set back."""
    lines = []
    for line in write_task(task).splitlines():
        found = COMMENT.match(line)
        value, comment = found.groups() if found else (line, "")
        lines.append(escape(value) + (f"<i>{escape(comment)}</i>" if comment else ""))
    return '<pre tabindex="0">' + "\n".join(lines) + "</pre>"


def definitions(items: Mapping[str, str]) -> str:
    """A list of terms and what they are."""
    return "<dl>" + "".join(f"<dt>{escape(key)}</dt><dd>{escape(value)}</dd>" for key, value in items.items()) + "</dl>"


def number(value: float | None, decimals: int, scale: float = 1.0) -> str:
    """A number for a cell; a dash where a quantile is infinite."""
    return DASH if value is None else f"{value * scale:.{decimals}f}"


def table(head: str, rows: Sequence[Row], kind: str = "plain") -> str:
    """A table whose first column heads its rows; cells are HTML."""
    body = "".join(
        f'<tr><th scope="row">{row[0]}</th>' + "".join(f"<td>{cell}</td>" for cell in row[1:]) + "</tr>" for row in rows
    )
    return f'<div class="wide"><table class="{kind}"><thead>{head}</thead><tbody>{body}</tbody></table></div>'
