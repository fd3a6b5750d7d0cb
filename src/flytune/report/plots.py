"""Figures of flights: each function returns the figure, or the sentence that says why there is nothing to draw."""

import math
from collections.abc import Mapping, Sequence
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
TRIALS_BEHIND = 100  # more lines than these only blacken the picture in 3-D
POINTS = 500  # per curve; a 10 s flight keeps every second sample
BANDS_IN_CLOSE_UP = 5
UNITS = {"x": "m", "y": "m", "z": "m", "yaw": "deg"}


def response(flights: Flights, judgement: Judgement, task: Task) -> go.Figure:
    """x, y, z, yaw and speed of the first trials against time, with a close-up of the last bands before the target."""
    rows = len(AXES) + 1
    figure = make_subplots(
        rows,
        2,
        shared_xaxes="all",  # pyright: ignore[reportArgumentType]  (its stub knows booleans only)
        vertical_spacing=0.04,
        horizontal_spacing=0.09,
        column_widths=[0.6, 0.4],
        specs=[[{}, {}]] * len(AXES) + [[{"colspan": 2}, None]],
        subplot_titles=[heading("whole flight"), heading(f"close-up: the target ± {BANDS_IN_CLOSE_UP} bands")],
    )
    shown = range(min(TRIALS_SHOWN, flights.trials))
    step = stride(flights)
    for row, axis in enumerate(AXES, start=1):
        values, target, band = course(flights, axis)
        for column in (1, 2):
            for trial in shown:
                name = f"trial {trial + 1}" + (" (crashed)" if judgement.crashed[trial] else "")
                curve = _curve(flights, values[trial], step, trial, name, legend=(row, column) == (1, 1))
                figure.add_trace(curve, row=row, col=column)
                figure.add_trace(_settled_dot(flights, values, judgement, axis, trial), row=row, col=column)
            target_and_band(figure, row, column, target, band)
        wide = BANDS_IN_CLOSE_UP * band
        figure.update_yaxes(title_text=f"{axis} [{UNITS[axis]}]", row=row, col=1)
        figure.update_yaxes(range=[target - wide, target + wide], row=row, col=2)
    _draw_altitude_bounds(figure, task, row=AXES.index("z") + 1)
    _draw_speed(figure, flights, judgement, shown, row=rows)
    figure.update_xaxes(range=[0, flights.duration], hoverformat=".2f")
    figure.update_xaxes(showticklabels=True, row=len(AXES))
    figure.update_xaxes(title_text="time [s]", row=rows, col=1)
    return style.frame(figure, 920, hovermode="x")


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
    flights: Flights, values: Float[np.ndarray, "K"], step: int, trial: int, name: str, legend: bool
) -> go.Scatter:
    return go.Scatter(
        x0=0,
        dx=step * float(flights.time[1]),
        y=values[::step].astype(np.float32),
        mode="lines",
        line={
            "color": style.TRIALS[trial],
            "width": 1.3,
            "dash": "dot" if "crashed" in name else "solid",
            "simplify": False,
        },
        name=name,
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


def _draw_altitude_bounds(figure: go.Figure, task: Task, row: int) -> None:
    for end in task.termination.values():
        if isinstance(end, MinimumAltitude):
            figure.add_hline(float(end.bound), line={"color": style.BOUND, "width": 1}, row=row, col=1)  # pyright: ignore[reportArgumentType]


def _draw_speed(figure: go.Figure, flights: Flights, judgement: Judgement, shown: range, row: int) -> None:
    step = stride(flights)
    for trial in shown:
        speed = np.linalg.norm(flights.velocity[trial], axis=-1)
        name = f"trial {trial + 1}" + (" (crashed)" if judgement.crashed[trial] else "")
        figure.add_trace(_curve(flights, speed, step, trial, name, legend=False), row=row, col=1)
    figure.update_yaxes(title_text="speed [m/s]", rangemode="tozero", row=row, col=1)
    if flights.speed_bound is not None:
        figure.add_hline(
            flights.speed_bound,
            line={"color": style.BOUND, "width": 1},
            annotation={"text": f"bound {flights.speed_bound:g} m/s", "font": {"color": style.BOUND}},
            annotation_position="bottom right",
            row=row,  # pyright: ignore[reportArgumentType]
            col=1,  # pyright: ignore[reportArgumentType]
        )


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


def margins(flights: Flights, judgement: Judgement) -> go.Figure | str:
    """Share of each termination's bound that is left over time: median, p5 to p95 and extremes over the trials."""
    if not flights.margins:
        return "The task has no termination condition, so there is no margin to draw."
    names = sorted(flights.margins, key=lambda name: _tightness(flights.margins[name]))
    columns, rows = min(3, len(names)), math.ceil(len(names) / 3)
    titles = [
        f"{heading(label(name, 26))}<br>crossed in {np.count_nonzero(judgement.violated[name])} of {flights.trials}"
        for name in names
    ]
    figure = make_subplots(
        rows, columns, shared_xaxes=True, vertical_spacing=0.32 / rows, horizontal_spacing=0.07, subplot_titles=titles
    )
    for index, name in enumerate(names):
        row, column = divmod(index, columns)
        _draw_margin(figure, flights, flights.margins[name], row + 1, column + 1, legend=index == 0)
    figure.update_xaxes(range=[0, flights.duration], hoverformat=".2f", showticklabels=True)
    for column in range(columns):
        last = max(range(column, len(names), columns)) // columns + 1
        figure.update_xaxes(title_text="time [s]", row=last, col=column + 1)
    figure.update_yaxes(title_text="margin [% of bound]", col=1)
    return style.frame(figure, 110 + 240 * rows, hovermode="x", margin={"l": 66, "r": 14, "t": 86, "b": 48})


def _tightness(margin: Float[np.ndarray, "N K"]) -> float:
    """What the median trial left of a bound at its worst instant: the smaller, the more the bound holds back."""
    return float(np.median(np.where(np.isfinite(margin), margin, -np.inf).min(axis=1)))


def _draw_margin(
    figure: go.Figure, flights: Flights, margin: Float[np.ndarray, "N K"], row: int, column: int, legend: bool
) -> None:
    step = 2 * stride(flights)
    levels = _percentiles(100.0 * margin[:, ::step], (0, 5, 50, 95, 100))
    common: dict[str, Any] = {"x0": 0, "dx": step * float(flights.time[1]), "mode": "lines", "showlegend": False}
    edge = {"width": 0, "color": style.AXES["x"]}
    for low, high, opacity, name in ((0, 4, 0.13, "smallest to largest"), (1, 3, 0.22, "p5 to p95")):
        figure.add_trace(go.Scatter(**common, y=levels[low], line=edge, hoverinfo="skip"), row=row, col=column)
        band = go.Scatter(
            **{**common, "showlegend": legend},
            y=levels[high],
            line=edge,
            fill="tonexty",
            fillcolor=f"rgba(11, 95, 165, {opacity})",
            name=name,
            hoverinfo="skip",
        )
        figure.add_trace(band, row=row, col=column)
    line = {"color": style.AXES["x"], "width": 1.5}
    median = go.Scatter(
        **{**common, "showlegend": legend}, y=levels[2], line=line, name="median", hovertemplate="%{y:.0f} %"
    )
    figure.add_trace(median, row=row, col=column)
    place: dict[str, Any] = {"row": row, "col": column}
    figure.add_hline(0, line={"color": style.BOUND, "width": 1}, **place)


def _percentiles(values: Float[np.ndarray, "N K"], levels: tuple[int, ...]) -> list[Float[np.ndarray, "K"]]:
    """Percentiles over the trials; a margin that is not finite belongs to a lost trial and counts as the worst."""
    counted = np.sort(np.where(np.isfinite(values), values, -np.inf), axis=0)
    chosen = [counted[max(math.ceil(level / 100 * len(counted)) - 1, 0)] for level in levels]
    return [np.where(np.isfinite(level), level, np.nan).astype(np.float32) for level in chosen]


def flights_3d(flights: Flights) -> go.Figure:
    """The trajectories in space: the first trials in colour with their starts, the others in grey, the target."""
    figure = go.Figure()
    step = 2 * stride(flights)
    shown = min(TRIALS_SHOWN, flights.trials)
    behind = flights.position[shown : shown + TRIALS_BEHIND, :: 2 * step]
    if len(behind):
        gaps = np.full((len(behind), 1, 3), np.nan)  # so that one trace holds many separate lines
        points = np.concatenate([behind, gaps], axis=1).reshape(-1, 3)
        figure.add_trace(_path(points, style.OTHERS, 2.0, f"{len(behind)} more trials"))
    for trial in range(shown):
        path = flights.position[trial, ::step]
        figure.add_trace(_path(path, style.TRIALS[trial], 4.0, f"trial {trial + 1}", group=str(trial)))
        figure.add_trace(_mark(path[0], style.TRIALS[trial], "circle", f"start of trial {trial + 1}", str(trial)))
    figure.add_trace(_mark(flights.target_position, style.BOUND, "diamond", "target", "target", legend=True))
    axis = {"gridcolor": style.HAIRLINE, "zeroline": False, "showbackground": False, "linecolor": style.QUIET}
    scene: Mapping[str, Any] = {
        **{f"{name}axis": {**axis, "title": {"text": f"{name} [m]"}} for name in "xyz"},
        "aspectmode": "data",
        "camera": {"eye": {"x": 1.2, "y": -1.4, "z": 0.72}, "center": {"x": 0, "y": 0, "z": -0.24}},
    }
    return style.frame(figure, 560, scene=scene, margin={"l": 0, "r": 0, "t": 40, "b": 0})


def _path(points: Float[np.ndarray, "M 3"], colour: str, width: float, name: str, group: str = "") -> go.Scatter3d:
    x, y, z = points.T.astype(np.float32)
    return go.Scatter3d(
        x=x,
        y=y,
        z=z,
        mode="lines",
        line={"color": colour, "width": width},
        name=name,
        legendgroup=group,
        hovertemplate="%{x:.2f}, %{y:.2f}, %{z:.2f} m" if group else None,
        hoverinfo=None if group else "skip",
    )


def _mark(
    point: Float[np.ndarray, "3"], colour: str, symbol: str, name: str, group: str, legend: bool = False
) -> go.Scatter3d:
    x, y, z = ([float(value)] for value in point)
    return go.Scatter3d(
        x=x,
        y=y,
        z=z,
        mode="markers",
        marker={"color": colour, "size": 5, "symbol": symbol},
        name=name,
        legendgroup=group,
        showlegend=legend,
        hovertemplate="%{x:.2f}, %{y:.2f}, %{z:.2f} m",
    )
