"""Colours and the frame of every figure: thin lines, few colours, safe for colour-blind eyes and for paper."""

from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

import plotly.graph_objects as go
from plotly.subplots import make_subplots

INK, QUIET, HAIRLINE = "#1f2933", "#7b8794", "#e4e7eb"
BOUND, BAND, OTHERS = "#b3261e", "rgba(46, 125, 50, 0.16)", "#cdd3da"
TRIALS = ("#0b5fa5", "#d1690e", "#12805c", "#8e4585", "#a58a00")  # after Okabe and Ito, darkened for thin lines
AXES = {"x": "#0b5fa5", "y": "#12805c", "z": "#8e4585", "yaw": "#d1690e"}
MANY = (*TRIALS, "#4aa3c7", "#6b7280", "#c2567a", "#5b7a1e", "#3f3d99")  # reward terms, causes, policies
FONT = "system-ui, -apple-system, 'Segoe UI', Roboto, 'Helvetica Neue', Arial, sans-serif"


def colour(index: int) -> str:
    """The colour of the term, cause or policy with this number; they repeat after ten."""
    return MANY[index % len(MANY)]


def label(name: str, longest: int = 40) -> str:
    """A name that a user typed, for a figure: cut if long, and escaped, since plotly reads a subset of HTML."""
    return escape(name if len(name) <= longest else name[: longest - 1] + "…")


def panels(rows: int, columns: int, titles: Sequence[str], **options: Any) -> go.Figure:
    """A figure of panels, the first line of each title in bold; options of plotly's `make_subplots`."""
    lines = [title.partition("<br>") for title in titles]
    headings = [f"<b>{first}</b>{line_break}{rest}" for first, line_break, rest in lines]
    return make_subplots(rows, columns, subplot_titles=headings, **options)


def at(row: int, column: int) -> dict[str, Any]:
    """The panel that something is added to, both counted from 1; plotly's types know text only."""
    return {"row": row, "col": column}


def frame(figure: go.Figure, height: int, margin: Mapping[str, int] | None = None, **layout: Any) -> go.Figure:
    """The figure in the house style, `height` pixels high; its width is that of the page."""
    figure.update_layout(
        height=height,
        template="none",
        font={"family": FONT, "size": 12.5, "color": INK},
        paper_bgcolor="white",
        plot_bgcolor="white",
        margin={"l": 66, "r": 14, "t": 64, "b": 48} | dict(margin or {}),
        legend={"orientation": "h", "x": 0, "xanchor": "left", "y": 1, "yref": "container", "yanchor": "top"},
        hoverlabel={"font": {"family": FONT, "size": 12}},
    )
    figure.update_layout(**layout)
    line = {"showline": True, "linecolor": QUIET, "linewidth": 1, "ticks": "outside", "ticklen": 4, "tickcolor": QUIET}
    for update in (figure.update_xaxes, figure.update_yaxes):
        update(gridcolor=HAIRLINE, zeroline=False, title_font_size=12.5, title_standoff=8, **line)
    return figure.update_annotations(font={"size": 12.5, "color": INK})


def room_for_names(number: int) -> int:
    """Pixels above the panels for the buttons, a legend of so many names, two to a line if long, and the titles."""
    return 56 + 29 * -(-number // 2)


def legend_below_tools(figure: go.Figure) -> go.Figure:
    """The figure with its legend under the row of buttons, which would lie upon a long one."""
    height: Any = figure.layout.height  # pyright: ignore[reportAttributeAccessIssue]
    return figure.update_layout(legend_y=1 - 28 / height)


def listed(words: Sequence[str]) -> str:
    """Words as a sentence lists them: a, b and c."""
    return " and ".join([", ".join(words[:-1]), words[-1]] if len(words) > 1 else words)
