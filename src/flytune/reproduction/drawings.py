"""The paper's figures (R21) for the page: the same as `figures` draws for paper, to be looked into."""

from collections.abc import Callable
from typing import Any

import numpy as np
import plotly.graph_objects as go
from plotly.subplots import make_subplots

from flytune.evaluation.judge import Judgement
from flytune.evaluation.table import AXES
from flytune.report import plots, style
from flytune.report.style import heading
from flytune.reproduction.curves import column
from flytune.reproduction.evidence import SHOWN, Evidence, Flown
from flytune.reproduction.study import ROLES

COLOURS = {role: style.colour(index) for index, role in enumerate(ROLES)}


def reward(evidence: Evidence) -> go.Figure:
    """Episode reward over environment steps: mean over seeds, and the band from the least to the greatest."""
    figure = go.Figure()
    for role in ROLES:
        curves = evidence.curves[role]
        length = min(map(len, curves))
        every = max(1, length // plots.POINTS)
        steps = column(curves[0], "steps")[:length:every]
        rewards = np.array([column(rows, "episode_reward")[:length:every] for rows in curves])
        known = np.isfinite(rewards).any(axis=0)
        low, mean, high = (of(rewards[:, known], axis=0) for of in (np.nanmin, np.nanmean, np.nanmax))
        edge = {"width": 0, "color": COLOURS[role]}
        shared = {"x": steps[known], "mode": "lines", "legendgroup": role}
        figure.add_trace(go.Scatter(**shared, y=low, line=edge, hoverinfo="skip", showlegend=False))
        figure.add_trace(
            go.Scatter(**shared, y=high, line=edge, fill="tonexty", fillcolor=_shade(COLOURS[role]), hoverinfo="skip",
                       showlegend=False)
        )  # fmt: skip
        figure.add_trace(go.Scatter(**shared, y=mean, line={"width": 1.6, "color": COLOURS[role]}, name=role))
    figure.update_xaxes(title_text="environment steps [1]", hoverformat=",.3s")
    figure.update_yaxes(title_text="episode reward [1]", hoverformat=".1f")
    return style.frame(figure, 420, hovermode="x")


def boxes(
    evidence: Evidence,
    flown: Flown,
    condition: str,
    unit: Callable[[str], tuple[str, float]],
    of: Callable[[Judgement, str], np.ndarray],
    logarithmic: bool = False,
) -> go.Figure:
    """Boxes of one metric per axis and behaviour, over all seeds and trials, with the number of trials drawn."""
    figure = make_subplots(1, len(AXES), horizontal_spacing=0.07, subplot_titles=[heading(axis) for axis in AXES])
    for panel, axis in enumerate(AXES, start=1):
        symbol, scale = unit(axis)
        ticks = []
        for place, role in enumerate(ROLES):
            judged = evidence.seat(role, flown, condition).judgements
            values = np.concatenate([of(judgement, axis) for judgement in judged])
            finite = values[np.isfinite(values)] * scale
            ticks.append(f"{role}<br>{finite.size} of {values.size}")
            figure.add_trace(plots.box(finite, place, role, COLOURS[role]), row=1, col=panel)
        here: dict[str, Any] = {"row": 1, "col": panel}
        figure.update_xaxes(tickvals=list(range(len(ROLES))), ticktext=ticks, range=[-0.6, len(ROLES) - 0.4], **here)
        kind: dict[str, Any] = {"type": "log"} if logarithmic else {"rangemode": "tozero"}
        figure.update_yaxes(title_text=f"[{symbol}]", row=1, col=panel, **kind)
    figure.update_xaxes(showgrid=False, tickangle=0, tickfont_size=10)
    return style.frame(figure, 400, showlegend=False)


def profile(evidence: Evidence, flown: Flown, condition: str) -> go.Figure:
    """x, y, z and yaw against time for the first tests of the first seed, the behaviours overlaid."""
    figure = make_subplots(len(AXES), 1, shared_xaxes=True, vertical_spacing=0.03)
    for row, axis in enumerate(AXES, start=1):
        target = band = 0.0
        for role in ROLES:
            flights = evidence.seat(role, flown, condition).flights
            values, target, band = plots.course(flights, axis)
            step = plots.stride(flights)
            shown = values[:SHOWN, ::step]
            gap = np.full((len(shown), 1), np.nan)
            time = np.broadcast_to(flights.time[::step], shown.shape)
            figure.add_trace(
                go.Scatter(
                    x=np.concatenate([time, gap], axis=1).ravel().astype(np.float32),
                    y=np.concatenate([shown, gap], axis=1).ravel().astype(np.float32),
                    mode="lines",
                    line={"color": COLOURS[role], "width": 1.2},
                    name=role,
                    legendgroup=role,
                    showlegend=row == 1,
                    hovertemplate="%{y:.3f}",
                ),
                row=row,
                col=1,
            )
        plots.target_and_band(figure, row, 1, target, band)
        figure.update_yaxes(title_text=f"{axis} [{plots.UNITS[axis]}]", row=row, col=1)
    figure.update_xaxes(title_text="time [s]", row=len(AXES), col=1)
    return style.frame(figure, 860)


def rotor_speed(evidence: Evidence, flown: Flown, condition: str) -> go.Figure:
    """Mean rotor speed of the first tests against time, and RMS and total variation of the action of all trials."""
    titles = ["mean rotor speed, five tests", "action, RMS", "action, total variation"]
    figure = make_subplots(
        1, 3, column_widths=[0.5, 0.25, 0.25], horizontal_spacing=0.08, subplot_titles=list(map(heading, titles))
    )
    for place, role in enumerate(ROLES):
        seat = evidence.seat(role, flown, condition)
        step = plots.stride(seat.flights)
        speed = seat.flights.rotor_speed_rpm[:SHOWN, 1::step].mean(axis=(0, 2))
        line = {"color": COLOURS[role], "width": 1.2}
        trace = go.Scatter(x=seat.flights.time[1::step], y=speed, mode="lines", line=line, name=role)
        figure.add_trace(trace, row=1, col=1)
        for panel, name in ((2, "action_rms"), (3, "action_total_variation")):
            values = np.concatenate([getattr(judgement, name) for judgement in seat.judgements])
            box = plots.box(values[np.isfinite(values)], place, role, COLOURS[role]).update(showlegend=False)
            figure.add_trace(box, row=1, col=panel)
    for panel in (2, 3):
        figure.update_xaxes(tickvals=list(range(len(ROLES))), ticktext=list(ROLES), row=1, col=panel, showgrid=False)
        figure.update_yaxes(rangemode="tozero", row=1, col=panel)
    figure.update_xaxes(title_text="time [s]", row=1, col=1)
    figure.update_yaxes(title_text="[rpm]", row=1, col=1)
    return style.frame(figure, 400)


def _shade(colour: str) -> str:
    return f"rgba({', '.join(str(int(colour[at : at + 2], 16)) for at in (1, 3, 5))}, 0.16)"
