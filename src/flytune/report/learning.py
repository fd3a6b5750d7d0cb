"""The learning curve: what one training earned, and what ended its episodes, update by update."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import plotly.graph_objects as go
from jaxtyping import Float
from plotly.subplots import make_subplots

from flytune.report import style
from flytune.report.style import heading, label

POINTS = 600  # per curve; of a longer training every point is the mean of a few updates

Rows = Sequence[Mapping[str, Any]]
Course = Float[np.ndarray, "updates"]


def learning(rows: Rows | None) -> go.Figure | str:
    """Reward per step and per term, reward per episode, and terminations per cause, over environment steps."""
    if rows is None:
        return "This controller comes without a training curve."
    steps = _number(rows, "steps")
    terms = [
        _line(steps, course, name, style.colour(index)) for index, (name, course) in enumerate(_table(rows, "terms"))
    ]
    causes = [
        _line(steps, counts, name, style.colour(index))
        for index, (name, counts) in enumerate(_table(rows, "terminations"))
        if np.nansum(counts) > 0
    ]
    panels = (
        ("reward per step", [_line(steps, _number(rows, "reward"), "total", style.INK, 1.8), *terms]),
        ("reward per episode", [_line(steps, _number(rows, "episode_reward"), "episode", style.INK, 1.8)]),
        ("episodes ended per update", causes),
    )
    drawable = [(title, lines) for title, lines in panels if any(_has_number(line) for line in lines)]
    if not drawable or not np.isfinite(steps).any():
        return "The training left no numbers that could be drawn."
    return _stack(drawable)


def ends_that_never_came(rows: Rows | None) -> list[str]:
    """Terminations of the training that ended not one episode."""
    return [name for name, counts in _table(rows or [], "terminations") if not np.nansum(counts) > 0]


def _stack(panels: Sequence[tuple[str, list[go.Scatter]]]) -> go.Figure:
    """The panels above each other over one axis of steps, each with a legend of its own beside it."""
    number = len(panels)
    titles = [heading(title) for title, _ in panels]
    gap = 0.2 / number
    figure = make_subplots(number, 1, shared_xaxes=True, vertical_spacing=gap, subplot_titles=titles)
    legends = {}
    for row, (title, lines) in enumerate(panels, start=1):
        legend = "legend" if row == 1 else f"legend{row}"
        for line in lines:
            figure.add_trace(line.update(legend=legend, showlegend=title != "reward per episode"), row=row, col=1)
        top = 1 - (row - 1) * (1 + gap) / number
        place = {"x": 1.01, "xanchor": "left", "y": top, "yref": "paper", "yanchor": "top"}
        legends[legend] = {"orientation": "v", **place}
        figure.update_yaxes(title_text="reward [1]" if "reward" in title else "episodes [1]", row=row, col=1)
    figure.update_xaxes(hoverformat=",.3s")
    figure.update_xaxes(title_text="environment steps [1]", row=number, col=1)
    margin = {"l": 66, "r": 14, "t": 40, "b": 48}
    return style.frame(figure, 90 + 240 * number, hovermode="x", margin=margin, **legends)


def _has_number(line: go.Scatter) -> bool:
    return bool(np.isfinite(np.asarray(line.y, dtype=float)).any())


def _line(steps: Course, values: Course, name: str, colour: str, width: float = 1.2) -> go.Scatter:
    return go.Scatter(
        x=_thin(steps),
        y=_thin(values),
        mode="lines" if len(steps) > 1 else "markers",
        line={"color": colour, "width": width},
        name=label(name, 24),
        hovertemplate="%{y:.3g}",
        connectgaps=True,
    )


def _number(rows: Rows, key: str) -> Course:
    """A column of the curve, NaN where a row holds no number."""
    return np.array([_float(row.get(key)) for row in rows])


def _table(rows: Rows, key: str) -> list[tuple[str, Course]]:
    """The columns of a nested table with their names, in the order in which they appear."""
    names = dict.fromkeys(name for row in rows for name in row.get(key) or {})
    return [(name, np.array([_float((row.get(key) or {}).get(name)) for row in rows])) for name in names]


def _float(value: float | int | None) -> float:
    return np.nan if value is None else float(value)


def _thin(values: Course) -> Float[np.ndarray, "points"]:
    """At most POINTS values, each the mean of neighbours; NaN only where all of them are."""
    size = max(1, -(-len(values) // POINTS))
    padded = np.append(values, np.full(-len(values) % size, np.nan)).reshape(-1, size)
    known = np.isfinite(padded)
    total, count = np.where(known, padded, 0.0).sum(axis=1), known.sum(axis=1)
    return np.divide(total, count, out=np.full(len(padded), np.nan), where=count > 0)
