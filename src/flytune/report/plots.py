"""Figures of flights: each function returns the figure, or the sentence that says why there is nothing to draw."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import plotly.graph_objects as go
from jaxtyping import Float
from plotly.subplots import make_subplots

from flytune.evaluation import metrics
from flytune.evaluation.flights import Flights
from flytune.evaluation.judge import AXES, Judgement
from flytune.report import style
from flytune.report.style import heading, label
from flytune.task.task import Task
from flytune.task.termination import MinimumAltitude

TRIALS_SHOWN = 5  # paper R21: the performance profile shows five tests
POINTS = 500  # per curve; a 10 s flight keeps every second sample
BANDS_IN_CLOSE_UP = 5
UNITS = {"x": "m", "y": "m", "z": "m", "yaw": "deg"}


def response(flights: Flights, judgement: Judgement, task: Task) -> go.Figure:
    """x, y, z and yaw of the first trials against time, with a close-up of the last bands before the target."""
    figure = make_subplots(
        len(AXES),
        2,
        shared_xaxes="all",  # pyright: ignore[reportArgumentType]  (its stub knows booleans only)
        vertical_spacing=0.04,
        horizontal_spacing=0.09,
        subplot_titles=[heading("whole flight"), heading(f"close-up: the target ± {BANDS_IN_CLOSE_UP} bands")],
    )
    for row, axis in enumerate(AXES, start=1):
        values, target, band = course(flights, axis)
        for column in (1, 2):
            for trial in range(min(TRIALS_SHOWN, flights.trials)):
                curve = _curve(flights, judgement, values[trial], trial, legend=(row, column) == (1, 1))
                figure.add_trace(curve, row=row, col=column)
                figure.add_trace(_settled_dot(flights, values, judgement, axis, trial), row=row, col=column)
            target_and_band(figure, row, column, target, band)
        wide = BANDS_IN_CLOSE_UP * band
        figure.update_yaxes(title_text=f"{axis} [{UNITS[axis]}]", row=row, col=1)
        figure.update_yaxes(range=[target - wide, target + wide], row=row, col=2)
    for end in task.termination.values():
        if isinstance(end, MinimumAltitude):
            _bound(figure, float(end.bound), row=AXES.index("z") + 1, col=1)
    return _over_time(figure, flights, rows=len(AXES), height=760)


def motion(flights: Flights, judgement: Judgement) -> go.Figure:
    """Roll, pitch, body rates, motor commands and speed of the first trials against time."""
    roll, pitch = _tilt(flights.attitude)
    rates, action = np.degrees(flights.body_rate), flights.action
    left = [("roll [deg]", roll), ("pitch [deg]", pitch)]
    left += [(f"rate {axis} [deg/s]", rates[..., index]) for index, axis in enumerate("xyz")]
    right = [(f"motor {motor + 1} [1]", action[..., motor]) for motor in range(action.shape[-1])]
    right += [("speed [m/s]", np.linalg.norm(flights.velocity, axis=-1))]
    figure = make_subplots(
        len(left),
        2,
        shared_xaxes="all",  # pyright: ignore[reportArgumentType]
        vertical_spacing=0.03,
        horizontal_spacing=0.09,
        subplot_titles=[heading("tilt and body rates"), heading("motor commands and speed")],
    )
    for column, panels in enumerate((left, right), start=1):
        for row, (title, values) in enumerate(panels, start=1):
            for trial in range(min(TRIALS_SHOWN, flights.trials)):
                curve = _curve(flights, judgement, values[trial], trial, legend=(row, column) == (1, 1))
                figure.add_trace(curve, row=row, col=column)
            figure.update_yaxes(title_text=title, row=row, col=column)
            if title.startswith("motor"):
                figure.update_yaxes(range=[-1.05, 1.05], row=row, col=column)
    figure.update_yaxes(rangemode="tozero", row=len(right), col=2)
    if flights.speed_bound is not None:
        text = {"text": f"bound {flights.speed_bound:g} m/s", "font": {"color": style.BOUND}}
        _bound(figure, flights.speed_bound, len(right), 2, annotation=text, annotation_position="bottom right")
    return _over_time(figure, flights, rows=len(left), height=860)


def _over_time(figure: go.Figure, flights: Flights, rows: int, height: int) -> go.Figure:
    """The figure in the house style, its panels over the time of the flights."""
    figure.update_xaxes(range=[0, flights.duration], hoverformat=".2f")
    figure.update_xaxes(title_text="time [s]", row=rows)
    return style.frame(figure, height, hovermode="x")


def _tilt(attitude: Float[np.ndarray, "N K 4"]) -> tuple[Float[np.ndarray, "N K"], Float[np.ndarray, "N K"]]:
    """Roll and pitch in degrees of unit quaternions (x, y, z, w): the ZYX angles beside yaw."""
    x, y, z, w = np.moveaxis(attitude, -1, 0)
    with np.errstate(invalid="ignore"):
        roll = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
        return np.degrees(roll), np.degrees(np.arcsin(np.clip(2 * (w * y - z * x), -1, 1)))


def _bound(figure: go.Figure, value: float, row: int, col: int, **options: Any) -> None:
    place: dict[str, Any] = {"row": row, "col": col}
    figure.add_hline(value, line={"color": style.BOUND, "width": 1}, **options, **place)


def stride(flights: Flights) -> int:
    """Every how many samples a curve has a point."""
    return max(1, flights.time.size // POINTS)


def course(flights: Flights, axis: str) -> tuple[Float[np.ndarray, "N K"], float, float]:
    """Values [N, K], target and band of an axis in its unit; yaw without jumps, as the judge reads it."""
    if axis != "yaw":
        index = AXES.index(axis)
        return flights.position[:, :, index], float(flights.target_position[index]), metrics.POSITION_BAND
    with np.errstate(invalid="ignore"):
        error = metrics.unwrapped_yaw_error(metrics.yaw_angle(flights.attitude), flights.target_yaw)
    return np.degrees(error + flights.target_yaw), math.degrees(flights.target_yaw), math.degrees(metrics.YAW_BAND)


def _curve(
    flights: Flights, judgement: Judgement, values: Float[np.ndarray, "K"], trial: int, legend: bool
) -> go.Scatter:
    """One trial over time, dotted where it crashed."""
    crashed = bool(judgement.crashed[trial])
    step = stride(flights)
    color, dash = style.TRIALS[trial], "dot" if crashed else "solid"
    return go.Scatter(
        x0=0,
        dx=step * float(flights.time[1]),
        y=values[::step].astype(np.float32),
        mode="lines",
        line={"color": color, "width": 1.3, "dash": dash, "simplify": False},
        name=f"trial {trial + 1}" + (" (crashed)" if crashed else ""),
        legendgroup=str(trial),
        showlegend=legend,
        hovertemplate="%{y:.3f}",
    )


def _settled_dot(flights: Flights, values: np.ndarray, judgement: Judgement, axis: str, trial: int) -> go.Scatter:
    """A dot on the curve at the settling time; invisible where the trial did not settle."""
    instant = judgement.settling_time[axis][trial]
    settled = np.isfinite(instant)
    sample = int(np.argmin(np.abs(flights.time - instant))) if settled else 0
    return go.Scatter(
        x=[float(instant) if settled else None],
        y=[float(values[trial, sample]) if settled else None],
        mode="markers",
        marker={"color": style.TRIALS[trial], "size": 6, "line": {"color": "white", "width": 1}},
        name=f"trial {trial + 1}",
        legendgroup=str(trial),
        showlegend=False,
        hovertemplate="settled at %{x:.2f} s",
    )


def target_and_band(figure: go.Figure, row: int, column: int, target: float, band: float) -> None:
    """Draw the target and the settling band behind the curves of a panel."""
    place: dict[str, Any] = {"row": row, "col": column}
    figure.add_hrect(target - band, target + band, fillcolor=style.BAND, line_width=0, layer="below", **place)
    figure.add_hline(target, line={"color": style.QUIET, "width": 1, "dash": "dash"}, layer="below", **place)


def spread(judgement: Judgement) -> go.Figure | str:
    """Box plots of settling time, overshoot and steady-state error per axis, with the number of trials in each box."""
    panels = (
        ("settling time", "settling time [s]", AXES, judgement.settling_time, 1.0),
        ("overshoot", "overshoot [% of the step]", AXES, judgement.overshoot, 100.0),
        ("steady-state error", "error [mm]", ("x", "y", "z"), judgement.steady_state_error, 1e3),
        ("", "error [deg]", ("yaw",), judgement.steady_state_error, math.degrees(1)),
    )
    figure = make_subplots(
        1,
        len(panels),
        column_widths=[0.31, 0.31, 0.24, 0.14],
        horizontal_spacing=0.07,
        subplot_titles=[heading(title) for title, *_ in panels],
    )
    drawn = 0
    for column, (_, unit, axes, values, scale) in enumerate(panels, start=1):
        ticks = []
        for place, axis in enumerate(axes):
            finite = values[axis][np.isfinite(values[axis])] * scale
            drawn += finite.size
            ticks.append(f"{axis}<br>{finite.size}/{judgement.trials}")
            figure.add_trace(box(finite, place, axis, style.AXES[axis]), row=1, col=column)
        figure.update_xaxes(tickvals=list(range(len(axes))), ticktext=ticks, range=[-0.6, len(axes) - 0.4], col=column)
        figure.update_yaxes(title_text=unit, rangemode="tozero", col=column)
    if not drawn:
        return "Every trial crashed, so there is no settling time, overshoot or steady-state error to draw."
    figure.update_xaxes(showgrid=False, tickangle=0, tickfont_size=11)
    return style.frame(figure, 430, showlegend=False, margin={"l": 66, "r": 14, "t": 40, "b": 56})


def box(values: Float[np.ndarray, "M"], place: int, name: str, colour: str) -> go.Box:
    """A box with all its values as dots, standing at the place on the x axis."""
    return go.Box(
        x=np.full(values.size, place, dtype=np.int8),
        y=values.astype(np.float32),
        name=name,
        width=0.55,
        boxpoints="all",
        jitter=0.6,
        pointpos=0,
        line={"color": colour, "width": 1.3},
        fillcolor="rgba(0, 0, 0, 0)",
        marker={"color": colour, "size": 3.5, "opacity": 0.35},
        hoverinfo="y",
        yhoverformat=".3f",
    )


def settled_share(judgements: Sequence[tuple[str, Judgement]]) -> go.Figure:
    """Share of all trials that have settled by each instant, per axis, one line per policy: no trial is left out."""
    figure = make_subplots(
        1, len(AXES), shared_yaxes=True, horizontal_spacing=0.025, subplot_titles=[heading(axis) for axis in AXES]
    )
    for index, (name, judgement) in enumerate(judgements):
        for column, axis in enumerate(AXES, start=1):
            settling = judgement.settling_time[axis]
            instants = np.sort(settling[np.isfinite(settling)])
            share = 100.0 * np.arange(instants.size + 1) / judgement.trials
            line = go.Scatter(
                x=np.concatenate([[0.0], instants, [judgement.duration]]).astype(np.float32),
                y=np.append(share, share[-1]).astype(np.float32),
                mode="lines",
                line={"shape": "hv", "width": 1.6, "color": style.colour(index)},
                name=label(name),
                legendgroup=str(index),
                showlegend=column == 1,
                hovertemplate="%{y:.0f} % by %{x:.2f} s",
            )
            figure.add_trace(line, row=1, col=column)
    longest = max(judgement.duration for _, judgement in judgements)
    figure.update_xaxes(title_text="time [s]", range=[0, longest])
    figure.update_yaxes(range=[-2, 103])
    figure.update_yaxes(title_text="settled [% of trials]", col=1)
    above = style.room_for_names(len(judgements))
    return style.legend_below_tools(style.frame(figure, 300 + above, margin={"l": 66, "r": 14, "t": above, "b": 48}))
