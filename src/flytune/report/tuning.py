"""The page of a tuning: the requirement and the response that was reached, and the reason of each edit."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import plotly.graph_objects as go

from flytune.evaluation.evaluate import Evaluation, evaluate
from flytune.evaluation.judge import Judgement
from flytune.evaluation.statistics import median, quantile
from flytune.evaluation.table import error_unit
from flytune.report import plots, style
from flytune.report.page import write_page
from flytune.tables import NULL, Cell, Column, Table, number


def write_tuning(path: Path, tuning: Mapping[str, Any], evaluation: Evaluation | None = None) -> None:
    """Write the page of a tuning (`Tuning.to_dict`), whole or not at all.

    `evaluation` is that of the best policy on its last validation set; the policy flies again where None.

    Raises:
        BadInput: the file cannot be written, or the best policy cannot be read.
    """
    evaluation = evaluation or evaluate_best(tuning)
    outcome = f"Met by iteration {tuning['best']}, on a validation set that the tuning had not used before."
    write_page(
        path,
        "tuning.html",
        title=tuning["title"],
        outcome=outcome if tuning["met"] else f"{tuning['why'][0].upper()}{tuning['why'][1:]}",
        requirement=requirement_table(tuning, evaluation.judgement),
        response=plots.response(evaluation.flights, evaluation.judgement, evaluation.task),
        best=tuning["best"],
        trials=evaluation.judgement.trials,
        edits=edit_table(tuning),
        iterations=response_per_iteration(tuning),
        validations=validation_table(tuning),
    )


def evaluate_best(tuning: Mapping[str, Any]) -> Evaluation:
    """The best policy of a tuning, flown again on the last validation set that it was judged on."""
    judged = _last_validation(tuning)["judgement"]
    return evaluate(
        tuning["directory"],
        trials=judged["trials"],
        seed=judged["seed"],
        duration=judged["duration"],
        initial_conditions=judged["starts"],
    )


def requirement_table(tuning: Mapping[str, Any], judgement: Judgement) -> Table:
    """What was required, what the best policy reached on the validation set, and whether that is met."""
    required, last = tuning["requirement"], _last_validation(tuning)
    misses, axes = last["misses"], last["axes"]
    asked = [required, *required["others"]]
    met, missed = Cell(text="met", tone="verdict good"), Cell(text="not met", tone="verdict bad")

    def verdict(measure: str, axis: str) -> Cell:
        return missed if measure in misses and axes.get(measure, required["axis"]) == axis else met

    rows = [
        (*row, verdict(measure, limits["axis"]))
        for limits in asked
        for measure, *row in _axis_rows(required, limits, judgement)
    ]
    times = np.stack([judgement.settling_time[limits["axis"]] for limits in asked])
    settled = int(np.sum(np.all(np.isfinite(times), axis=0)))
    share = f"at least {100 * required['settled']:g} %"
    reached = f"{100 * settled / judgement.trials:g} % ({settled} of {judgement.trials})"
    rows.append(("trials that settle", share, reached, missed if "settled" in misses else met))
    if "constraints_satisfied" in misses:
        satisfied = 100 * (required["settled"] + misses["constraints_satisfied"])
        rows.append(("trials that satisfy your constraints", share, f"{satisfied:.3g} %", missed))
    return Table.plain((required["axis"], "required", "reached", ""), rows, style="narrow")


def _axis_rows(required: Mapping[str, Any], limits: Mapping[str, Any], judgement: Judgement) -> list[tuple[str, ...]]:
    """Measure, title, what was required and what was reached, for one axis."""
    axis, percentile = limits["axis"], limits["percentile"]
    leading = axis == required["axis"]
    whose = "" if leading else f"{axis}: "
    unit, scale, decimals = error_unit(axis)
    level = "median" if percentile == 50 else f"percentile {percentile:g}"
    longest = required["settling_time"] * (1 if required["at_most"] else 1 + required["tolerance"])
    time = f"at most {longest:.3g} s"
    if leading and not required["at_most"]:
        time = f"{required['settling_time']:g} s ± {100 * required['tolerance']:g} %"
    settling_time = quantile(judgement.settling_time[axis], percentile / 100)
    overshoot, error = median(judgement.overshoot[axis]), median(judgement.steady_state_error[axis])
    return [
        ("settling_time", f"{whose}settling time, {level}", time, _with_unit(settling_time, 2, 1.0, "s")),
        (
            "overshoot",
            f"{whose}overshoot, median",
            f"at most {100 * limits['overshoot']:g} %",
            _with_unit(overshoot, 1, 100.0, "%"),
        ),
        (
            "error",
            f"{whose}steady-state error, median",
            f"at most {scale * limits['error']:.3g} {unit}",
            _with_unit(error, decimals, scale, unit),
        ),
    ]


def edit_table(tuning: Mapping[str, Any]) -> Table:
    """Every edit, its reason and its result."""
    rows = [
        (
            Cell(text=str(each["number"]), page=f"iteration\N{NO-BREAK SPACE}{each['number']}"),
            "start" if each["parent"] is None else f"from {each['parent']}",
            each["edit"],
            each["result"],
            f"{each['seconds']:.0f} s of training",
        )
        for each in tuning["iterations"]
    ]
    return Table.plain(("iteration", "parent", "edit and reason", "result", "duration"), rows, style="stacked")


def validation_table(tuning: Mapping[str, Any]) -> Table:
    """Every iteration that was judged on a validation set, and what misses the requirement there."""
    axis = tuning["requirement"]["axis"]
    unit, scale, _ = error_unit(axis)

    def response(validation: Mapping[str, Any]) -> Mapping[str, Any]:
        judged = validation["judgement"]
        return judged["position"] if axis == "position" else judged["axes"][axis]

    columns = (
        Column("iteration", lambda each: each["iteration"]),
        Column("seed", lambda each: each["seed"]),
        Column("settling time [s]", lambda each: response(each)["settling_time"]["median"], decimals=2),
        Column("settled", lambda each: f"{response(each)['settled']}/{each['judgement']['trials']}"),
        Column("overshoot [%]", lambda each: response(each)["overshoot"]["median"], decimals=1, scale=100.0),
        Column(f"error [{unit}]", lambda each: response(each)["steady_state_error"]["median"], decimals=2, scale=scale),
        Column("not met", lambda each: ", ".join(each["misses"]).replace("_", " ") or "-", align="left"),
    )
    return Table.of(columns, tuning["validations"], style="dense")


def response_per_iteration(tuning: Mapping[str, Any]) -> go.Figure:
    """Settling time, overshoot and error over the iterations, each with the range that is required."""
    required, lines = tuning["requirement"], tuning["iterations"]
    numbers = [line["number"] for line in lines]
    unit, scale, _ = error_unit(required["axis"])
    wanted = required["settling_time"]
    spread = required["tolerance"] * wanted
    lowest, highest = (0.0, wanted) if required["at_most"] else (wanted - spread, wanted + spread)
    panels = (
        ("settling time [s]", "settling_time", 1.0, lowest, highest),
        ("overshoot [%]", "overshoot", 100.0, 0.0, 100 * required["overshoot"]),
        (f"steady-state error [{unit}]", "error", scale, 0.0, scale * required["error"]),
    )
    figure = style.panels(1, 3, [title for title, *_ in panels], horizontal_spacing=0.08)
    fills = [style.TRIALS[0] if each == tuning["best"] else "white" for each in numbers]
    marker = {"size": 9, "color": fills, "line": {"color": style.TRIALS[0], "width": 1.6}}
    points: dict[str, Any] = {"mode": "markers", "marker": marker, "hovertemplate": "%{y:.3g}"}
    edges: dict[str, Any] = {"mode": "lines", "line": {"color": style.TRIALS[0], "width": 1.2}, "hoverinfo": "skip"}
    steps = [(line["parent"], line["number"]) for line in lines if line["parent"] is not None]
    ends = [end for step in steps for end in (*step, None)]
    for column, (_, name, factor, low, high) in enumerate(panels, start=1):
        values = [None if line["response"][name] is None else factor * line["response"][name] for line in lines]
        at = dict(zip(numbers, values, strict=True))
        place = style.at(1, column)
        heights = [None if end is None else at[end] for end in ends]
        figure.add_trace(go.Scatter(x=ends, y=heights, showlegend=False, **edges), **place)
        figure.add_trace(go.Scatter(x=numbers, y=values, showlegend=False, **points), **place)
        # after the traces: plotly leaves an empty panel without it
        figure.add_hrect(y0=low, y1=high, fillcolor=style.BAND, line_width=0, **place)
        top = max([value for value in values if value is not None] + [high]) or 1.0
        figure.update_yaxes(range=[0, 1.1 * top], **place)
    figure.update_xaxes(title_text="iteration", dtick=1 if len(numbers) < 15 else None)
    return style.frame(figure, 360, margin={"l": 50})


def _last_validation(tuning: Mapping[str, Any]) -> Mapping[str, Any]:
    """The last validation of the best iteration."""
    return next(each for each in reversed(tuning["validations"]) if each["iteration"] == tuning["best"])


def _with_unit(value: float | None, decimals: int, scale: float, unit: str) -> str:
    return NULL if value is None else f"{number(value, decimals, scale)} {unit}"
