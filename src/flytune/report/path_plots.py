"""Figures of a target that moves: the tracking error over time."""

from typing import Any

import numpy as np
import plotly.graph_objects as go

from flytune.evaluation import metrics
from flytune.evaluation.flights import Flights
from flytune.evaluation.judge import Judgement
from flytune.report import style
from flytune.report.plots import curve, over_time, quantiles, stride


def tracking(flights: Flights, judgement: Judgement) -> go.Figure:
    """The distance from the target over time: median, p5 to p95 and largest of all trials, with the band."""
    step = stride(flights)
    distance = np.linalg.norm(np.asarray(flights.position, np.float64) - flights.target_position, axis=-1)[:, ::step]
    distance = 1e3 * np.where(judgement.crashed[:, None] | ~np.isfinite(distance), np.inf, distance)
    low, middle, high, largest = quantiles(distance, 0.05, 0.5, 0.95, 1.0)
    figure = style.panels(1, 1, ["distance from the target"])
    edge: dict[str, Any] = {"line": {"width": 0, "color": style.AXES["x"]}, "hoverinfo": "skip", "showlegend": False}
    shade = {"fill": "tonexty", "fillcolor": "rgba(11, 95, 165, 0.22)", "name": "p5 to p95", "showlegend": True}
    figure.add_trace(curve(flights, step, low, **edge))
    figure.add_trace(curve(flights, step, high, **(edge | shade)))
    hover = {"hovertemplate": "%{y:.1f} mm"}
    figure.add_trace(
        curve(flights, step, middle, line={"color": style.AXES["x"], "width": 1.6}, name="median", **hover)
    )
    dots = {"color": style.QUIET, "width": 1, "dash": "dot"}
    figure.add_trace(curve(flights, step, largest, line=dots, name="largest", **hover))
    figure.add_hline(1e3 * metrics.POSITION_BAND, line={"color": style.AXES["y"], "width": 1, "dash": "dash"})
    if judgement.tracking:
        figure.add_vline(judgement.tracking.begin, line={"color": style.QUIET, "width": 1})
    figure.update_yaxes(title_text="distance [mm]", type="log", exponentformat="none")
    return style.frame(over_time(figure, flights, rows=1), 360, hovermode="x")
