"""Figures of flights: each function returns the figure, or the sentence that says why there is nothing to draw."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import plotly.graph_objects as go
from jaxtyping import Float

from flytune.evaluation import metrics
from flytune.evaluation.flights import Flights
from flytune.evaluation.judge import AXES, Judgement
from flytune.evaluation.statistics import ranked
from flytune.report import style
from flytune.report.style import label
from flytune.task.task import Task
from flytune.task.termination import MinimumAltitude

TRIALS_SHOWN = 5  # paper R21: the performance profile shows five tests
POINTS = 500  # per curve; a 10 s flight keeps every second sample
BANDS_IN_CLOSE_UP = 5
UNITS = {"x": "m", "y": "m", "z": "m", "yaw": "deg"}


def response(flights: Flights, judgement: Judgement, task: Task) -> go.Figure:
    """x, y, z and yaw of the first trials against time, with a close-up of the last bands before the target.

    Of a target that moves, the close-up shows the error.
    """
    what = "the error within" if flights.moving else "the target ±"
    titles = ["whole flight", f"close-up: {what} {BANDS_IN_CLOSE_UP} bands"]
    figure = style.panels(4, 2, titles, shared_xaxes="all", vertical_spacing=0.04, horizontal_spacing=0.09)
    for row, axis in enumerate(AXES, start=1):
        values, target, band = course(flights, axis)
        whole, close = (values, target), (values - target, 0.0) if flights.moving else (values, target)
        for column, (values, target) in enumerate((whole, close), start=1):
            for trial in range(min(TRIALS_SHOWN, flights.trials)):
                line = _trial(flights, judgement, values, trial, legend=(row, column) == (1, 1))
                dot = _settled_dot(flights, judgement, values, trial, axis)
                figure.add_traces([line, dot], rows=row, cols=column)
            target_and_band(figure, row, column, target, band, flights)
        _, middle = close
        wide = BANDS_IN_CLOSE_UP * band
        figure.update_yaxes(title_text=f"{axis} [{UNITS[axis]}]", row=row, col=1)
        figure.update_yaxes(range=[middle - wide, middle + wide], row=row, col=2)
    for end in task.termination.values():
        if isinstance(end, MinimumAltitude):
            _bound(figure, float(end.bound), row=AXES.index("z") + 1, column=1)
    return style.frame(over_time(figure, flights, rows=4), 760, hovermode="x")


def motion(flights: Flights, judgement: Judgement) -> go.Figure:
    """Roll, pitch, body rates, motor commands and speed of the first trials against time."""
    roll, pitch = _tilt(flights.attitude)
    rates, action = np.degrees(flights.body_rate), flights.action
    left = [("roll [deg]", roll), ("pitch [deg]", pitch)]
    left += [(f"rate {axis} [deg/s]", rates[..., index]) for index, axis in enumerate("xyz")]
    right = [(f"motor {motor + 1} [1]", action[..., motor]) for motor in range(action.shape[-1])]
    right += [("speed [m/s]", np.linalg.norm(flights.velocity, axis=-1))]
    titles = ["tilt and body rates", "motor commands and speed"]
    figure = style.panels(5, 2, titles, shared_xaxes="all", vertical_spacing=0.03, horizontal_spacing=0.09)
    for column, panels in enumerate((left, right), start=1):
        for row, (title, values) in enumerate(panels, start=1):
            for trial in range(min(TRIALS_SHOWN, flights.trials)):
                line = _trial(flights, judgement, values, trial, legend=(row, column) == (1, 1))
                figure.add_trace(line, row=row, col=column)
            figure.update_yaxes(title_text=title, row=row, col=column)
            if title.startswith("motor"):
                figure.update_yaxes(range=[-1.05, 1.05], row=row, col=column)
    figure.update_yaxes(rangemode="tozero", row=5, col=2)
    if flights.speed_bound is not None:
        text = {"text": f"bound {flights.speed_bound:g} m/s", "font": {"color": style.BOUND}}
        _bound(figure, flights.speed_bound, 5, 2, annotation=text, annotation_position="bottom right")
    return style.frame(over_time(figure, flights, rows=5), 860, hovermode="x")


def over_time(figure: go.Figure, flights: Flights, rows: int) -> go.Figure:
    """The figure, its panels over the time of the flights, which stands under the last row."""
    figure.update_xaxes(range=[0, flights.duration], hoverformat=".2f")
    return figure.update_xaxes(title_text="time [s]", row=rows)


def _tilt(attitude: Float[np.ndarray, "N K 4"]) -> tuple[Float[np.ndarray, "N K"], Float[np.ndarray, "N K"]]:
    """Roll and pitch in degrees of unit quaternions (x, y, z, w): the ZYX angles beside yaw."""
    x, y, z, w = np.moveaxis(attitude, -1, 0)
    with np.errstate(invalid="ignore"):
        roll = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
        return np.degrees(roll), np.degrees(np.arcsin(np.clip(2 * (w * y - z * x), -1, 1)))


def _bound(figure: go.Figure, value: float, row: int, column: int, **options: Any) -> None:
    figure.add_hline(value, line={"color": style.BOUND, "width": 1}, **options, **style.at(row, column))


def stride(flights: Flights) -> int:
    """The number of samples from one point of a curve to the next."""
    return max(1, flights.time.size // POINTS)


def curve(flights: Flights, step: int, values: Float[np.ndarray, "points"], **options: Any) -> go.Scatter:
    """A line over time through every `step`-th sample."""
    dx = step * float(flights.time[1])
    return go.Scatter(x0=0, dx=dx, y=values.astype(np.float32), mode="lines", **options)


def quantiles(values: Float[np.ndarray, "N K"], *shares: float) -> list[Float[np.ndarray, "K"]]:
    """Quantiles over the trials at every instant, see `ranked`; NaN, a gap in a curve, where one is infinite."""
    found = (ranked(values, share) for share in shares)
    return [np.where(np.isfinite(level), level, np.nan).astype(np.float32) for level in found]


def course(flights: Flights, axis: str) -> tuple[Float[np.ndarray, "N K"], Any, float]:
    """Values [N, K], target and band of an axis in its unit; yaw without jumps, as the judge reads it.

    The target is a number, or [K] of one that moves.
    """
    if axis != "yaw":
        index = AXES.index(axis)
        target = flights.target_position[..., index]
        return flights.position[:, :, index], target if flights.moving else float(target), metrics.POSITION_BAND
    with np.errstate(invalid="ignore"):
        yaw, aim = metrics.yaw_angle(flights.attitude), flights.target_yaw
        if flights.moving:
            error = metrics.unwrapped_yaw_error(yaw - aim, 0.0)
            return np.degrees(error + aim), np.degrees(aim), math.degrees(metrics.YAW_BAND)
        error = metrics.unwrapped_yaw_error(yaw, aim)
    return np.degrees(error + aim), math.degrees(aim), math.degrees(metrics.YAW_BAND)


def _trial(
    flights: Flights, judgement: Judgement, values: Float[np.ndarray, "N K"], trial: int, legend: bool
) -> go.Scatter:
    """One trial over time, dotted where it crashed."""
    crashed, step = bool(judgement.crashed[trial]), stride(flights)
    dash = "dot" if crashed else "solid"
    return curve(
        flights,
        step,
        values[trial, ::step],
        line={"color": style.TRIALS[trial], "width": 1.3, "dash": dash, "simplify": False},
        name=f"trial {trial + 1}" + (" (crashed)" if crashed else ""),
        legendgroup=str(trial),
        showlegend=legend,
        hovertemplate="%{y:.3f}",
    )


def _settled_dot(flights: Flights, judgement: Judgement, values: np.ndarray, trial: int, axis: str) -> go.Scatter:
    """A dot on the curve at the settling time; invisible where the trial did not settle."""
    instant = float(judgement.settling_time[axis][trial])
    x = y = None
    if math.isfinite(instant):
        x, y = instant, float(values[trial, np.argmin(np.abs(flights.time - instant))])
    return go.Scatter(
        x=[x],
        y=[y],
        mode="markers",
        marker={"color": style.TRIALS[trial], "size": 6, "line": {"color": "white", "width": 1}},
        name=f"trial {trial + 1}",
        legendgroup=str(trial),
        showlegend=False,
        hovertemplate="settled at %{x:.2f} s",
    )


def target_and_band(figure: go.Figure, row: int, column: int, target: Any, band: float, flights: Flights) -> None:
    """Draw the target, a number or [K], and the settling band behind the curves of a panel."""
    if np.ndim(target):
        step = stride(flights)
        line = {"color": style.QUIET, "width": 1, "dash": "dash"}
        course = curve(flights, step, target[::step], line=line, name="target", showlegend=False, hoverinfo="skip")
        figure.add_trace(course, row=row, col=column)
        return
    # plotly's add_hrect and add_hline draw the same, thirty times slower
    wide = {"x0": 0, "x1": 1, "xref": "x domain", "layer": "below", **style.at(row, column)}
    figure.add_shape(type="rect", y0=target - band, y1=target + band, fillcolor=style.BAND, line={"width": 0}, **wide)
    figure.add_shape(type="line", y0=target, y1=target, line={"color": style.QUIET, "width": 1, "dash": "dash"}, **wide)


def spread(judgement: Judgement) -> go.Figure | str:
    """Box plots of settling time, overshoot and steady-state error per axis, with the number of trials in each box."""
    panels = (
        ("settling time", "settling time [s]", AXES, judgement.settling_time, 1.0),
        ("overshoot", "overshoot [% of the step]", AXES, judgement.overshoot, 100.0),
        ("steady-state error", "error [mm]", ("x", "y", "z"), judgement.steady_state_error, 1e3),
        ("", "error [deg]", ("yaw",), judgement.steady_state_error, math.degrees(1)),
    )
    titles = [title for title, *_ in panels]
    figure = style.panels(1, 4, titles, column_widths=[0.31, 0.31, 0.24, 0.14], horizontal_spacing=0.07)
    drawn = 0
    for column, (_, unit, axes, values, scale) in enumerate(panels, start=1):
        of_all = f"<br>{{}}/{judgement.trials}"
        boxes = [(values[axis] * scale, style.AXES[axis], axis + of_all, {"name": axis}) for axis in axes]
        drawn += draw_boxes(figure, style.at(1, column), unit, boxes)
    if not drawn:
        return "Every trial crashed, so there is no settling time, overshoot or steady-state error to draw."
    return style.frame(figure, 430, showlegend=False, margin={"t": 40, "b": 56})


def draw_boxes(
    figure: go.Figure,
    place: dict[str, Any],
    unit: str,
    boxes: Sequence[tuple[Float[np.ndarray, "N"], str, str, dict[str, Any]]],
) -> int:
    """The number of values drawn: boxes side by side in a panel, each with all its values as dots.

    Args:
        figure: with the panel.
        place: of the panel, see `style.at`.
        unit: of the values.
        boxes: of each box: values, of which those that are finite are drawn; colour; text below it, with {} for the
            number of values drawn; further options of the trace.
    """
    ticks, drawn = [], 0
    for number, (values, colour, text, options) in enumerate(boxes):
        finite = values[np.isfinite(values)].astype(np.float32)
        drawn += finite.size
        ticks.append(text.format(finite.size))
        box = go.Box(
            x=np.full(finite.size, number, dtype=np.int8),
            y=finite,
            width=0.55,
            boxpoints="all",
            jitter=0.6,
            pointpos=0,
            line={"color": colour, "width": 1.3},
            fillcolor="rgba(0, 0, 0, 0)",
            marker={"color": colour, "size": 3.5, "opacity": 0.35},
            hoverinfo="y",
            yhoverformat=".3f",
            **options,
        )
        figure.add_trace(box, **place)
    ends = [-0.6, len(boxes) - 0.4]
    look = {"showgrid": False, "tickangle": 0, "tickfont_size": 11}
    figure.update_xaxes(tickvals=list(range(len(boxes))), ticktext=ticks, range=ends, **look, **place)
    figure.update_yaxes(title_text=unit, rangemode="tozero", **place)
    return drawn


def settled_share(judgements: Sequence[Judgement]) -> go.Figure:
    """Share of all trials that have settled by each instant, per axis, one line per controller: none is left out."""
    figure = style.panels(1, 4, AXES, shared_yaxes=True, horizontal_spacing=0.025)
    for index, judgement in enumerate(judgements):
        for column, axis in enumerate(AXES, start=1):
            settling = judgement.settling_time[axis]
            instants = np.sort(settling[np.isfinite(settling)])
            share = 100.0 * np.arange(instants.size + 1) / judgement.trials
            line = go.Scatter(
                x=np.concatenate([[0.0], instants, [judgement.duration]]).astype(np.float32),
                y=np.append(share, share[-1]).astype(np.float32),
                mode="lines",
                line={"shape": "hv", "width": 1.6, "color": style.colour(index)},
                name=label(f"{index + 1} {judgement.name}"),
                legendgroup=str(index),
                showlegend=column == 1,
                hovertemplate="%{y:.0f} % by %{x:.2f} s",
            )
            figure.add_trace(line, row=1, col=column)
    figure.update_xaxes(title_text="time [s]", range=[0, max(judgement.duration for judgement in judgements)])
    figure.update_yaxes(range=[-2, 103])
    figure.update_yaxes(title_text="settled [% of trials]", col=1)
    above = style.room_for_names(len(judgements))
    return style.legend_below_tools(style.frame(figure, 300 + above, margin={"t": above}))
