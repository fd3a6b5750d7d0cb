"""Figures of the space that flights use: the margin to each bound, and the paths."""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import plotly.graph_objects as go
from jaxtyping import Float

from flytune.evaluation.flights import Flights
from flytune.evaluation.judge import Judgement
from flytune.report import style
from flytune.report.plots import TRIALS_SHOWN, curve, quantiles, stride
from flytune.report.style import label

TRIALS_BEHIND = 100  # more lines than these only blacken the picture in 3-D
HOVER = "%{x:.2f}, %{y:.2f}, %{z:.2f} m"


def margins(flights: Flights, judgement: Judgement) -> go.Figure | str:
    """Share of each termination's bound that is left over time: median, p5 to p95 and extremes over the trials."""
    if not flights.margins:
        return "The task has no termination condition, so there is no margin to draw."
    names = sorted(flights.margins, key=lambda name: _tightness(flights.margins[name]))
    columns, rows = min(3, len(names)), math.ceil(len(names) / 3)
    crossed = {name: np.count_nonzero(judgement.violated[name]) for name in names}
    titles = [f"{label(name, 26)}<br>crossed in {crossed[name]} of {flights.trials}" for name in names]
    figure = style.panels(
        rows, columns, titles, shared_xaxes=True, vertical_spacing=0.32 / rows, horizontal_spacing=0.07
    )
    drawn = []
    for index, name in enumerate(names):
        row, column = divmod(index, columns)
        place = style.at(row + 1, column + 1)
        drawn.append(_draw_margin(figure, flights, flights.margins[name], place, legend=index == 0))
    figure.update_xaxes(range=[0, flights.duration], hoverformat=".2f", showticklabels=True)
    for column in range(columns):
        last = max(range(column, len(names), columns)) // columns + 1
        figure.update_xaxes(title_text="time [s]", row=last, col=column + 1)
    lowest = min(float(np.nanmin(levels, initial=0.0)) for levels in drawn)
    figure.update_yaxes(range=[max(lowest, -100.0) - 5, 102])
    figure.update_yaxes(title_text="margin [% of bound]", col=1)
    return style.frame(figure, 110 + 240 * rows, margin={"t": 86}, hovermode="x")


def _tightness(margin: Float[np.ndarray, "N K"]) -> float:
    """The margin of the median trial at its worst instant: the smaller, the more the bound limits the flights."""
    return float(np.median(np.where(np.isfinite(margin), margin, -np.inf).min(axis=1)))


def _draw_margin(
    figure: go.Figure, flights: Flights, margin: Float[np.ndarray, "N K"], place: dict[str, Any], legend: bool
) -> list[Float[np.ndarray, "drawn"]]:
    """The curves of a panel, which are drawn, from the smallest to the largest margin."""
    step = 2 * stride(flights)
    percent = 100.0 * np.minimum(margin[:, ::step], 1.0)  # altitudes may have more
    # a margin that is not finite belongs to a lost trial, and counts as the worst
    levels = quantiles(np.where(np.isfinite(percent), percent, -np.inf), 0.0, 0.05, 0.5, 0.95, 1.0)
    edge: dict[str, Any] = {"line": {"width": 0, "color": style.AXES["x"]}, "hoverinfo": "skip"}
    for low, high, opacity, name in ((0, 4, 0.13, "smallest to largest"), (1, 3, 0.22, "p5 to p95")):
        shade = {"fill": "tonexty", "fillcolor": f"rgba(11, 95, 165, {opacity})", "name": name}
        figure.add_trace(curve(flights, step, levels[low], **edge, showlegend=False), **place)
        figure.add_trace(curve(flights, step, levels[high], **edge, **shade, showlegend=legend), **place)
    line = {"color": style.AXES["x"], "width": 1.5}
    median = {"line": line, "name": "median", "hovertemplate": "%{y:.0f} %", "showlegend": legend}
    figure.add_trace(curve(flights, step, levels[2], **median), **place)
    figure.add_hline(0, line={"color": style.BOUND, "width": 1}, **place)
    return levels


def flights_3d(flights: Flights) -> go.Figure:
    """The trajectories in space: the first trials in colour with their starts, the others in grey, the target."""
    figure = go.Figure()
    step = 2 * stride(flights)
    shown = min(TRIALS_SHOWN, flights.trials)
    behind = flights.position[shown : shown + TRIALS_BEHIND, :: 4 * step]
    if len(behind):
        gaps = np.full((len(behind), 1, 3), np.nan)  # so that one trace holds many separate lines
        points = np.concatenate([behind, gaps], axis=1).reshape(-1, 3)
        figure.add_trace(_path(points, style.OTHERS, 2.0, f"{len(behind)} more trials"))
    for trial in range(shown):
        path = flights.position[trial, ::step]
        figure.add_trace(_path(path, style.TRIALS[trial], 4.0, f"trial {trial + 1}", group=str(trial)))
        figure.add_trace(_mark(path[0], style.TRIALS[trial], "circle", f"start of trial {trial + 1}", str(trial)))
    _draw_target(figure, flights)
    axis = {"gridcolor": style.HAIRLINE, "zeroline": False, "showbackground": False, "linecolor": style.QUIET}
    scene: Mapping[str, Any] = {
        **{f"{name}axis": {**axis, "title": {"text": f"{name} [m]"}} for name in "xyz"},
        "aspectmode": "data",
        "camera": {"eye": {"x": 1.2, "y": -1.4, "z": 0.72}, "center": {"x": 0, "y": 0, "z": -0.24}},
    }
    return style.frame(figure, 560, scene=scene, margin={"l": 0, "r": 0, "t": 40, "b": 0})


def _draw_target(figure: go.Figure, flights: Flights) -> None:
    """The target: a mark for each of its places, or the line that it moves along."""
    steps = flights.steps
    if flights.moving and not steps:
        path = flights.target_position[:: stride(flights)]
        figure.add_trace(_path(path, style.BOUND, 3.0, "path of the target", group="target"))
        figure.add_trace(_mark(path[0], style.BOUND, "diamond", "start of the path", "target"))
        return
    places = np.unique([one.target_position for one in steps], axis=0) if steps else [flights.target_position]
    for number, place in enumerate(places):
        figure.add_trace(_mark(place, style.BOUND, "diamond", "target", "target", legend=number == 0))


def _path(points: Float[np.ndarray, "M 3"], colour: str, width: float, name: str, group: str = "") -> go.Scatter3d:
    x, y, z = points.T.astype(np.float32)
    options = {"line": {"color": colour, "width": width}, "name": name, "legendgroup": group}
    hover = {"hovertemplate": HOVER} if group else {"hoverinfo": "skip"}
    return go.Scatter3d(x=x, y=y, z=z, mode="lines", **options, **hover)


def _mark(
    point: Float[np.ndarray, "3"], colour: str, symbol: str, name: str, group: str, legend: bool = False
) -> go.Scatter3d:
    x, y, z = ([float(value)] for value in point)
    marker = {"color": colour, "size": 5, "symbol": symbol}
    options = {"name": name, "legendgroup": group, "showlegend": legend, "hovertemplate": HOVER}
    return go.Scatter3d(x=x, y=y, z=z, mode="markers", marker=marker, **options)
