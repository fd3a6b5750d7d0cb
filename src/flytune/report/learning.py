"""The learning curve: the reward of one training, and what ended its episodes, update by update."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import plotly.graph_objects as go
from jaxtyping import Float

from flytune.report import style
from flytune.report.style import label

POINTS = 600  # per curve; of a longer training every point is the mean of a few updates

Rows = Sequence[Mapping[str, Any]]
Course = Float[np.ndarray, "updates"]


def learning(rows: Rows | None) -> go.Figure | str:
    """Reward per step and per term, reward per episode, and terminations per cause, over environment steps."""
    if rows is None:
        return "This controller comes without a training curve."
    steps = _column(rows, "steps")
    terms, causes = (
        [(line, name, style.colour(index), 1.2) for index, (name, line) in enumerate(_table(rows, key))]
        for key in ("terms", "terminations")
    )
    curves = {
        "reward per step": [(_column(rows, "reward"), "total", style.INK, 1.8), *terms],
        "reward per episode": [(_column(rows, "episode_reward"), "episode", style.INK, 1.8)],
        "episodes ended per update": [cause for cause in causes if np.nansum(cause[0]) > 0],
    }
    drawable = {title: lines for title, lines in curves.items() if any(np.isfinite(line[0]).any() for line in lines)}
    if not drawable or not np.isfinite(steps).any():
        return "The training left no numbers that could be drawn."
    return _stack({title: [_line(steps, *line) for line in lines] for title, lines in drawable.items()})


def ends_that_never_came(rows: Rows | None) -> list[str]:
    """Terminations that ended no episode of the training."""
    return [name for name, counts in _table(rows or [], "terminations") if not np.nansum(counts) > 0]


def _stack(panels: Mapping[str, Sequence[go.Scatter]]) -> go.Figure:
    """The panels above each other over one axis of steps, each with a legend of its own beside it."""
    number = len(panels)
    gap = 0.2 / number
    figure = style.panels(number, 1, list(panels), shared_xaxes=True, vertical_spacing=gap)
    legends = {}
    for row, (title, lines) in enumerate(panels.items(), start=1):
        legend = "legend" if row == 1 else f"legend{row}"
        for line in lines:
            figure.add_trace(line.update(legend=legend, showlegend=title != "reward per episode"), row=row, col=1)
        top = 1 - (row - 1) * (1 + gap) / number
        place = {"x": 1.01, "xanchor": "left", "y": top, "yref": "paper", "yanchor": "top"}
        legends[legend] = {"orientation": "v", **place}
        figure.update_yaxes(title_text="reward [1]" if "reward" in title else "episodes [1]", row=row, col=1)
    figure.update_xaxes(hoverformat=",.3s")
    figure.update_xaxes(title_text="environment steps [1]", row=number, col=1)
    return style.frame(figure, 90 + 240 * number, margin={"t": 40}, hovermode="x", **legends)


def _line(steps: Course, values: Course, name: str, colour: str, width: float) -> go.Scatter:
    return go.Scatter(
        x=_thin(steps),
        y=_thin(values),
        mode="lines" if len(steps) > 1 else "markers",
        line={"color": colour, "width": width},
        name=label(name, 24),
        hovertemplate="%{y:.3g}",
        connectgaps=True,
    )


def _column(rows: Rows, key: str) -> Course:
    """A column of the curve, NaN where a row holds no number."""
    return np.array([row.get(key) for row in rows], dtype=float)


def _table(rows: Rows, key: str) -> list[tuple[str, Course]]:
    """The columns of a nested table with their names, in the order in which they appear."""
    tables = [row.get(key) or {} for row in rows]
    names = dict.fromkeys(name for table in tables for name in table)
    return [(name, _column(tables, name)) for name in names]


def _thin(values: Course) -> Float[np.ndarray, "points"]:
    """At most POINTS values, each the mean of neighbours; NaN only where all of them are."""
    size = max(1, -(-len(values) // POINTS))
    padded = np.append(values, np.full(-len(values) % size, np.nan)).reshape(-1, size)
    known = np.isfinite(padded)
    total, count = np.where(known, padded, 0.0).sum(axis=1), known.sum(axis=1)
    return np.divide(total, count, out=np.full(len(padded), np.nan), where=count > 0)
