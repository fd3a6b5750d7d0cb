"""The page of a tuning: what was asked, the response step by step, and the reason for each edit."""

import math
from collections.abc import Mapping
from html import escape
from pathlib import Path
from typing import Any

import plotly.graph_objects as go
from plotly.subplots import make_subplots

from flytune.config.files import check_file, write_text
from flytune.report import style
from flytune.report.page import drawing, page


def write_tuning(path: Path, tuning: Mapping[str, Any]) -> None:
    """Write the page of a tuning, whole or not at all.

    Args:
        path: the file.
        tuning: `Tuning.to_dict`.

    Raises:
        BadInput: the file cannot be written.
    """
    check_file(path)
    write_text(path, page("flytune tune", _body(tuning)))


def _body(tuning: Mapping[str, Any]) -> str:
    outcome = (
        f"Met: step {tuning['best']}, on starts the tuning never saw."
        if tuning["met"]
        else f"{tuning['why'][0].upper()}{tuning['why'][1:]}"
    )
    caption = (
        "Each point is one policy, judged on the same starts; a line leads to it from the one that was edited. The "
        "green band is what is asked, the filled point the policy that was kept. A step without a settling time has "
        "too few trials that settle."
    )
    return (
        f"<h1>{escape(tuning['title'])}</h1><p class='lead'>{escape(outcome)}</p>"
        f"<h3>The response, step by step</h3>{drawing(response_per_step(tuning), caption)}"
        f"<h3>Every edit and its reason</h3>{_steps(tuning)}"
        f"<h3>Fresh starts</h3>{_verdicts(tuning)}"
    )


def response_per_step(tuning: Mapping[str, Any]) -> go.Figure:
    """Settling time, overshoot and error over the steps, each with the band that is asked for."""
    asked, lines = tuning["requirement"], tuning["iterations"]
    numbers = [line["number"] for line in lines]
    degrees = asked["axis"] == "yaw"
    scale, unit = (math.degrees(1), "deg") if degrees else (1e3, "mm")
    wanted = asked["settling_time"]
    spread = asked["tolerance"] * wanted
    panels = (
        ("settling time [s]", "settling_time", 1.0,
         (0.0, wanted) if asked["at_most"] else (wanted - spread, wanted + spread)),
        ("overshoot [%]", "overshoot", 100.0, (0.0, 100 * asked["overshoot"])),
        (f"steady-state error [{unit}]", "error", scale, (0.0, scale * asked["error"])),
    )  # fmt: skip
    figure = make_subplots(1, 3, subplot_titles=[style.heading(title) for title, *_ in panels], horizontal_spacing=0.08)
    for column, (_, name, factor, (low, high)) in enumerate(panels, start=1):
        values = [None if line["response"][name] is None else factor * line["response"][name] for line in lines]
        kept = [style.TRIALS[0] if number == tuning["best"] else "white" for number in numbers]
        marker = {"size": 9, "color": kept, "line": {"color": style.TRIALS[0], "width": 1.6}}
        at = dict(zip(numbers, values, strict=True))
        ways = [(line["parent"], line["number"]) for line in lines if line["parent"] is not None]
        figure.add_trace(
            go.Scatter(x=[end for way in ways for end in (*way, None)],
                       y=[end for first, second in ways for end in (at[first], at[second], None)],
                       mode="lines", line={"color": style.TRIALS[0], "width": 1.2}, showlegend=False,
                       hoverinfo="skip"),
            row=1, col=column,
        )  # fmt: skip
        figure.add_trace(
            go.Scatter(x=numbers, y=values, mode="markers", marker=marker, showlegend=False,
                       hovertemplate="%{y:.3g}"),
            row=1, col=column,
        )  # fmt: skip
        # after the trace: plotly leaves an empty panel without it
        figure.add_hrect(y0=low, y1=high, fillcolor=style.BAND, line_width=0, row=1, col=column)  # pyright: ignore
        top = max([value for value in values if value is not None] + [high]) or 1.0
        figure.update_yaxes(range=[0, 1.1 * top], row=1, col=column)
    figure.update_xaxes(title_text="step", dtick=1 if len(numbers) < 15 else None)
    return style.frame(figure, 360, margin={"l": 50, "r": 14, "t": 64, "b": 48})


def _steps(tuning: Mapping[str, Any]) -> str:
    rows = "".join(
        f"<tr><th>{line['number']}</th><td>{'' if line['parent'] is None else line['parent']}</td>"
        f"<td>{escape(line['edit'])}</td><td>{escape(line['result'])}</td><td>{line['seconds']:.0f} s</td></tr>"
        for line in tuning["iterations"]
    )
    head = "<tr><th>step</th><th>from</th><th>edit and reason</th><th>what it did</th><th>training</th></tr>"
    return f'<div class="wide"><table class="words"><thead>{head}</thead><tbody>{rows}</tbody></table></div>'


def _verdicts(tuning: Mapping[str, Any]) -> str:
    rows = []
    for verdict in tuning["validations"]:
        judged = verdict["judgement"]
        axis = tuning["requirement"]["axis"]
        channel = judged["position"] if axis == "position" else judged["axes"][axis]
        median = channel["settling_time"]["median"]
        rows.append(
            f"<tr><th>{verdict['iteration']}</th><td>{verdict['seed']}</td>"
            f"<td>{'-' if median is None else f'{median:.2f} s'}</td>"
            f"<td>{channel['settled']}/{judged['trials']}</td><td>{_percent(channel['overshoot']['median'])}</td>"
            f"<td>{_error(channel['steady_state_error']['median'], axis)}</td>"
            f"<td>{escape(', '.join(verdict['misses']).replace('_', ' ')) or 'nothing'}</td></tr>"
        )
    if not rows:
        return '<p class="empty">No step came near enough to be judged on fresh starts.</p>'
    head = (
        "<tr><th>step</th><th>seed of the starts</th><th>settling time, median</th><th>settled</th>"
        "<th>overshoot, median</th><th>error, median</th><th>missing</th></tr>"
    )
    return f'<div class="wide"><table><thead>{head}</thead><tbody>{"".join(rows)}</tbody></table></div>'


def _percent(value: float | None) -> str:
    return "-" if value is None else f"{100 * value:.1f} %"


def _error(value: float | None, axis: str) -> str:
    if value is None:
        return "-"
    return f"{math.degrees(value):.2f} deg" if axis == "yaw" else f"{1e3 * value:.1f} mm"
