"""Figures of several controllers over the same trials; a controller has one colour and one number in all of them."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import plotly.graph_objects as go
from jaxtyping import Float

from flytune.evaluation import metrics
from flytune.evaluation.comparison import Comparison
from flytune.evaluation.difference import Difference
from flytune.evaluation.flights import Flights
from flytune.evaluation.judge import CHANNELS
from flytune.report import plots, style
from flytune.report.style import label

TRIALS_SHOWN = 3  # of each controller, the first ones; more lines than these hide each other
FLOOR = 0.002  # of the band; an error below it is drawn there, as a logarithmic axis has no zero
BOXES = (
    "position.settling_time",
    "yaw.settling_time",
    "position.overshoot",
    "yaw.overshoot",
    "position.steady_state_error",
    "yaw.steady_state_error",
    "peak_speed",
    "action.total_variation",
)


def responses(flights: Sequence[Flights], comparison: Comparison) -> go.Figure:
    """x, y, z, yaw and distance of the same few trials of every controller, and the errors of all trials over time."""
    titles = ["the same few trials", "error over all trials: median and middle half"]
    figure = style.panels(5, 2, titles, shared_xaxes="all", vertical_spacing=0.03, horizontal_spacing=0.1)
    shown = min(TRIALS_SHOWN, flights[0].trials)
    opacity = 0.16 if len(flights) < 4 else 0.07  # many shades above each other only darken the picture
    for row, channel in enumerate(CHANNELS, start=1):
        unit = plots.UNITS.get(channel, "m")
        _, target, band = _course(flights[0], channel)
        errors = []
        for index, flown in enumerate(flights):
            figure.add_trace(_trials(flown, channel, shown, index), row=row, col=1)
            errors += _errors(flown, comparison.judgements[index].crashed, channel, index, opacity)
        figure.add_traces(errors, rows=row, cols=2)
        plots.target_and_band(figure, row, 1, target, band, flights[0])
        low, high = _reach(errors, band)
        place = style.at(row, 2)
        figure.add_hrect(low / 2, band, fillcolor=style.BAND, line_width=0, layer="below", **place)
        decades = {"type": "log", "dtick": 1, "exponentformat": "none", "range": [math.log10(low), math.log10(high)]}
        figure.update_yaxes(title_text=f"|{channel} error| [{unit}]", **decades, **place)
        title_text = f"{'distance' if channel == 'position' else channel} [{unit}]"
        figure.update_yaxes(title_text=title_text, row=row, col=1)
    plots.over_time(figure, flights[0], rows=5)
    return _finish(figure, comparison.names, range(len(flights)), 1000, hovermode="x")


def _reach(errors: Sequence[go.Scatter], band: float) -> tuple[float, float]:
    """Ends of an axis that shows all curves, and the edge of the band, with some room."""
    values = np.concatenate([np.asarray(trace.y, dtype=np.float64) for trace in errors])
    known = np.append(values[np.isfinite(values)], band)
    return known.min() / 1.6, known.max() * 1.6


def _course(flights: Flights, channel: str) -> tuple[Float[np.ndarray, "N K"], Any, float]:
    """Values, target and band of an axis, or the distance from the target, which is to be 0."""
    if channel != "position":
        return plots.course(flights, channel)
    return np.linalg.norm(flights.position - flights.target_position, axis=-1), 0.0, metrics.POSITION_BAND


def _error(flights: Flights, channel: str) -> Float[np.ndarray, "N K"]:
    """Absolute error of a channel in the unit of its course; of yaw the shorter way round, as the band sees it."""
    values, target, _ = _course(flights, channel)
    error = np.asarray(values, dtype=np.float64) - target
    return np.abs(np.degrees(metrics.wrap_angle(np.radians(error))) if channel == "yaw" else error)


def _trials(flights: Flights, channel: str, shown: int, index: int) -> go.Scatter:
    """The first trials of one controller as one trace, so that its name hides and shows them together."""
    step = plots.stride(flights)
    values = _course(flights, channel)[0][:shown, ::step]
    gap = np.full((shown, 1), np.nan)
    time = np.broadcast_to(flights.time[::step], values.shape)
    return go.Scatter(
        x=np.concatenate([time, gap], axis=1).ravel().astype(np.float32),
        y=np.concatenate([values, gap], axis=1).ravel().astype(np.float32),
        mode="lines",
        line={"color": style.colour(index), "width": 1.3, "simplify": False},
        hovertemplate="%{y:.3f}",
        meta=index,
    )


def _errors(flights: Flights, crashed: np.ndarray, channel: str, index: int, opacity: float) -> list[go.Scatter]:
    """Median and middle half of the error over all trials; a crashed trial is infinitely far at every instant."""
    step = plots.stride(flights)
    error = _error(flights, channel)[:, ::step]
    error = np.where(crashed[:, None] | np.isnan(error), np.inf, error)
    floor = FLOOR * _course(flights, channel)[2]
    low, middle, high = (np.maximum(level, floor) for level in plots.quantiles(error, 0.25, 0.5, 0.75))
    colour = style.colour(index)
    edge: dict[str, Any] = {"line": {"width": 0, "color": colour}, "hoverinfo": "skip", "meta": index}
    shade = f"rgba({', '.join(str(int(colour[at : at + 2], 16)) for at in (1, 3, 5))}, {opacity})"
    line = {"color": colour, "width": 1.8, "simplify": False}
    return [
        plots.curve(flights, step, low, **edge),
        plots.curve(flights, step, high, **edge, fill="tonexty", fillcolor=shade),
        plots.curve(flights, step, middle, line=line, hovertemplate="%{y:.4f}", meta=index),
    ]


def boxes(comparison: Comparison) -> go.Figure | str:
    """Box plots of each metric, the controllers side by side, with the number of trials that each box holds."""
    chosen = [metric for metric in comparison.metrics if metric.name in BOXES]
    titles = [metric.title for metric in chosen]
    figure = style.panels(2, 4, titles, vertical_spacing=0.2, horizontal_spacing=0.07)
    drawn = 0
    for panel, metric in enumerate(chosen):
        row, column = divmod(panel, 4)
        unit, scale = metric.shown
        side_by_side = [
            (metric.values(judgement) * scale, style.colour(index), f"<b>{index + 1}</b><br>{{}}", {"meta": index})
            for index, judgement in enumerate(comparison.judgements)
        ]
        drawn += plots.draw_boxes(figure, style.at(row + 1, column + 1), f"[{unit}]", side_by_side)
    if not drawn:
        return "Every trial of every controller crashed, so there is nothing to draw."
    return _finish(figure, comparison.names, range(len(comparison.names)), 580)


def paired(comparison: Comparison) -> go.Figure:
    """Median difference of each controller from the reference, metric by metric, with its interval; zero is as good."""
    columns = 4
    rows = math.ceil(len(comparison.metrics) / columns)
    others = [index for index in range(len(comparison.names)) if index != comparison.reference]
    gap = 92  # px between the panels of a column, for ticks and titles
    height = rows * (38 + 24 * len(others)) + (rows - 1) * gap
    titles = [metric.title for metric in comparison.metrics]
    figure = style.panels(rows, columns, titles, vertical_spacing=gap / height, horizontal_spacing=0.05)
    for panel, metric in enumerate(comparison.metrics):
        row, column = divmod(panel, columns)
        place = style.at(row + 1, column + 1)
        found = [one for one in comparison.differences if one.metric is metric]
        _draw_differences(figure, found, others, place)
        more, less = metric.ways
        figure.update_xaxes(title_text=f"← {less}  [{metric.shown[0]}]  {more} →", **place)
    ticks = {"tickvals": list(range(len(others))), "ticktext": [f"<b>{index + 1}</b>" for index in others]}
    figure.update_yaxes(**ticks, range=[len(others) - 0.4, -0.6])
    figure.update_xaxes(nticks=5, tickfont_size=11, exponentformat="none")
    figure = _finish(figure, comparison.names, others, height)
    figure.update_yaxes(showgrid=False)
    figure.update_xaxes(zeroline=True, zerolinecolor=style.INK, zerolinewidth=1.2)
    return figure.update_xaxes(title_font_size=11.5, title_font_color=style.QUIET)


def _draw_differences(
    figure: go.Figure, differences: Sequence[Difference], controllers: Sequence[int], place: dict[str, Any]
) -> None:
    """One panel: a dot and its interval per controller; what is infinite stands as a triangle at the edge."""
    _, scale = differences[0].metric.shown
    ends = np.array([[one.low, one.median, one.high] for one in differences]) * scale
    known = np.append(ends[np.isfinite(ends)], 0.0)
    spread = float(np.ptp(known)) or 1.0
    left, right = float(known.min()) - 0.18 * spread, float(known.max()) + 0.18 * spread
    for height, (controller, difference, three) in enumerate(zip(controllers, differences, ends, strict=True)):
        low, middle, high = np.clip(three, left, right)
        colour = style.colour(controller)
        symbol = "circle" if np.isfinite(three[1]) else f"triangle-{'right' if three[1] > 0 else 'left'}"
        line = {"color": colour, "width": 3}
        bar = go.Scatter(x=[low, high], y=[height, height], mode="lines", line=line, hoverinfo="skip", meta=controller)
        marker = {"color": colour, "size": 10, "symbol": symbol, "line": {"color": "white", "width": 1}}
        dot = go.Scatter(x=[middle], y=[height], mode="markers", marker=marker, cliponaxis=False, meta=controller)
        figure.add_trace(bar, **place)
        figure.add_trace(dot.update(hovertemplate=_hover(difference, three)), **place)
    figure.update_xaxes(range=[left, right], **place)


def _hover(difference: Difference, ends: Float[np.ndarray, "3"]) -> str:
    """The text that is shown when somebody points at a dot."""
    low, middle, high = (f"{end:.4g}" for end in ends)
    return (
        f"{middle} ({low} to {high})<br>smaller in {difference.better}, larger in {difference.worse}, "
        f"equal in {difference.tied}, left out {difference.left_out}"
    )


def _finish(
    figure: go.Figure, names: Sequence[str], controllers: Sequence[int], height: int, **layout: Any
) -> go.Figure:
    """The figure in the house style, every trace named after its controller, and a legend of the controllers above it.

    The legend has entries of its own, since a controller may have nothing to draw in a panel.
    """
    texts = [f"<b>{number}</b> {label(name)}" for number, name in enumerate(names, start=1)]
    traces: Any = figure.select_traces()
    for trace in traces:
        if trace.meta is not None:  # a target that moves is nobody's
            trace.update(name=texts[trace.meta], legendgroup=str(trace.meta), meta=None)
    figure.update_traces(showlegend=False)
    for controller in controllers:
        marker = {"color": style.colour(controller), "symbol": "square", "size": 11}
        entry = go.Scatter(x=[None], y=[None], mode="markers", marker=marker, name=texts[controller], hoverinfo="skip")
        figure.add_trace(entry.update(legendgroup=str(controller)))
    above = style.room_for_names(len(controllers))
    figure = style.frame(figure, height + above + 48, margin={"t": above}, **layout)
    figure.update_annotations(font_size=11.5)  # titles of four panels side by side
    return style.legend_below_tools(figure)
