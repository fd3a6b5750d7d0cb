"""Tables of the comparison as HTML; every text that somebody typed is escaped here."""

import math
from collections.abc import Sequence
from html import escape

import numpy as np

from flytune.evaluation.comparison import Comparison
from flytune.evaluation.difference import METRICS
from flytune.evaluation.judge import CHANNELS, Judgement
from flytune.report.comparison_plots import title, unit
from flytune.report.style import colour
from flytune.report.tables import DASH, number, table

INFINITY, MINUS = "\N{INFINITY}", "\N{MINUS SIGN}"


def controllers_table(judged: Sequence[tuple[str, Judgement]]) -> str:
    """One row per controller (name, judgement) that flew the same trials: settled trials, response, action, failures."""
    head = (
        '<tr><th rowspan="2">controller</th><th colspan="5">settled</th><th colspan="2">settling [s]</th>'
        '<th rowspan="2">over-<br>shoot<br>[%]</th><th colspan="2">final error</th>'
        '<th rowspan="2">peak<br>speed<br>[m/s]</th><th colspan="2">action</th>'
        '<th rowspan="2">crossed<br>a bound</th><th rowspan="2">crashed</th></tr>'
        "<tr><th>x</th><th>y</th><th>z</th><th>yaw</th><th>pos.</th><th>median</th><th>p95</th>"
        "<th>[mm]</th><th>[deg]</th><th>RMS</th><th>change</th></tr>"
    )
    rows = []
    for index, (name, judgement) in enumerate(judged):
        told = judgement.to_dict()
        position, action = told["position"], told["action"]
        crossed = np.any([np.zeros(judgement.trials, dtype=bool), *judgement.violated.values()], axis=0)
        rows.append(
            (
                controller(index, name),
                *(str(judgement.settled(channel)) for channel in CHANNELS),
                number(position["settling_time"]["median"], 2),
                number(position["settling_time"]["p95"], 2),
                number(position["overshoot"]["median"], 1, 100.0),
                number(position["steady_state_error"]["median"], 1, 1e3),
                number(told["axes"]["yaw"]["steady_state_error"]["median"], 2, math.degrees(1)),
                number(told["peak_speed"]["median"], 2),
                number(action["rms"], 3),
                number(action["total_variation"], 4),
                str(np.count_nonzero(crossed)),
                str(told["crashed"]),
            )
        )
    return table(head, rows, "dense")


def paired_table(comparison: Comparison) -> str:
    """One row per metric, one column per controller but the reference: the median difference, its interval, the trials."""
    others = [index for index in range(len(comparison.names)) if index != comparison.reference]
    titles = "".join(f"<th>{controller(index, comparison.names[index])}</th>" for index in others)
    rows = []
    for metric in METRICS:
        symbol, scale = unit(metric)
        found = [one for one in comparison.differences if one.metric is metric]
        cells = (
            f"<strong>{signed(one.median * scale)}</strong>"
            f"<br>{signed(one.low * scale)} to {signed(one.high * scale)}"
            f"<br>{one.better} : {one.worse}" + f" ({one.left_out} left out)" * (one.left_out > 0)
            for one in found
        )
        rows.append((f"{title(metric)} [{symbol}]", *cells))
    return table(
        f"<tr><th>less {escape(comparison.names[comparison.reference])}</th>{titles}</tr>", rows, "dense narrow"
    )


def controller(index: int, name: str) -> str:
    """A controller's name behind its number, which wears its colour."""
    badge = (
        "display:inline-block; min-width:1.5em; padding:0 0.35em; margin-right:0.4em; border-radius:3px; "
        f"text-align:center; font-weight:700; color:#fff; background:{colour(index)}"
    )
    return f'<span style="{badge}">{index + 1}</span>{escape(name)}'


def signed(value: float) -> str:
    """A difference with its sign, to three digits."""
    if math.isnan(value):
        return DASH
    if math.isinf(value):
        return ("+" if value > 0 else MINUS) + INFINITY
    return f"{value:+.3g}".replace("-", MINUS) if value else "0"
