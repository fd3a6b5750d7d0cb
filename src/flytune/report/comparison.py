"""The comparison: one self-contained page on how several controllers fly the same trials."""

from collections.abc import Sequence
from html import escape
from pathlib import Path

import numpy as np

from flytune.config.files import check_file, write_text
from flytune.errors import BadInput
from flytune.evaluation.comparison import Comparison
from flytune.evaluation.comparison_table import conditions, sentences
from flytune.report import comparison_plots, comparison_tables, page, plots, tables
from flytune.report.report import Entry

SAME_PLACE = 1e-4  # m; another simulator may round the start, which is metres away


def write_comparison(path: Path, entries: Sequence[Entry], comparison: Comparison) -> None:
    """Write the comparison of two or more controllers as one HTML file, whole or not at all.

    Args:
        path: the file; one that is there is replaced.
        entries: the controllers, in the order of the comparison, which names them.
        comparison: of their judgements.

    Raises:
        BadInput: the controllers are not those of the comparison or started elsewhere, or the file cannot be written.
    """
    if len(entries) != len(comparison.judgements):
        number = len(comparison.judgements)
        raise BadInput(
            f"compare: {len(entries)} entries is not allowed. Allowed: {number}, one per judgement, in order."
        )
    first, *others = (entry.flights.position[:, 0] - entry.flights.target_position for entry in entries)
    for name, initial_conditions in zip(comparison.names[1:], others, strict=True):
        if not np.allclose(initial_conditions, first, rtol=0, atol=SAME_PLACE, equal_nan=True):
            raise BadInput(
                f"starts: {name} starts elsewhere, seen from its target, than {comparison.names[0]}. "
                "Allowed: the same for every controller. Fly all of them with one --task."
            )
    check_file(path)
    write_text(path, _page(entries, comparison))


def _page(entries: Sequence[Entry], comparison: Comparison) -> str:
    names, flights = comparison.names, [entry.flights for entry in entries]
    judged = list(zip(names, comparison.judgements, strict=True))
    shares = plots.settled_share([(f"{index} {name}", judgement) for index, (name, judgement) in enumerate(judged, 1)])
    reference = comparison_tables.controller(comparison.reference, names[comparison.reference])
    against = f"Each controller less the reference {reference}, trial by trial:"
    tasks = [(name, entry.task) for name, entry in zip(names, entries, strict=True)]
    parts = {
        "Side by side": comparison_tables.controllers_table(judged) + _CAPTIONS["table"],
        "In words": _words(comparison),
        "Paired differences": page.drawing(comparison_plots.paired(comparison), against + _CAPTIONS["paired"]),
        "The same trials": page.drawing(comparison_plots.responses(flights, comparison), _CAPTIONS["responses"]),
        "All trials": page.drawing(comparison_plots.boxes(comparison), _CAPTIONS["boxes"]),
        "Settled by when": page.drawing(shares, _CAPTIONS["share"]),
        "Every difference": comparison_tables.paired_table(comparison) + _CAPTIONS["numbers"],
        "How their tasks differ": tables.differences_table(tasks),
        "About each controller": "".join(
            f"<h4>{comparison_tables.controller(index, name)}</h4>{_about(entry)}"
            for index, (name, entry) in enumerate(zip(names, entries, strict=True))
        ),
    }
    links = "".join(f'<a href="#s{number}">{name}</a>' for number, name in enumerate(parts))
    body = "".join(f'<h3 id="s{number}">{name}</h3>{html}' for number, (name, html) in enumerate(parts.items()))
    head = (
        f'<h1>{len(entries)} controllers compared</h1><p class="quiet">{escape(conditions(comparison.judgements))}</p>'
    )
    return page.page("flytune comparison", f"{head}<nav>{links}</nav>{body}")


def _words(comparison: Comparison) -> str:
    """The differences of each controller in plain words."""
    against = comparison.names[comparison.reference]
    paragraphs = []
    for name in comparison.names:
        found = sentences([one for one in comparison.differences if one.name == name], against)
        if found:
            first, *more = (escape(text).replace(" %", "&nbsp;%") for text in found)
            items = "".join(f"<li>{text}</li>" for text in more)
            state = " open" if len(comparison.names) == 2 else ""
            paragraphs.append(f"<details{state}><summary>{first}</summary><ul>{items}</ul></details>")
    return "".join(paragraphs)


def _about(entry: Entry) -> str:
    return tables.definitions(entry.about) if entry.about else '<p class="empty">Nothing is known of it.</p>'


_CAPTIONS = {
    "table": f"""
<p class="quiet">Settled: trials that settle on the axis. Medians and p95 are over all trials; one that failed counts
as infinite, and {tables.DASH} says that the quantile falls among those. Crossed: trials that crossed some bound of the
controller's task.</p>""",
    "paired": """
the dot is the median, the bar its 95&nbsp;% bootstrap interval over
trials. On the dark line there is no difference; left of it the controller has less, which is better for times, overshoot
and errors, and neither good nor bad for speed and action. A triangle at the edge is an infinite median: in most trials
one of the two fails and the other does not. An interval tells about these controllers, not about others trained or tuned
the same way; and of twenty such intervals one misses by chance.""",
    "responses": """
Left: the first trials, which start alike for every controller and meet the same noise. Right: over all trials, on a
logarithmic axis, the median error (line) and the middle half of the trials (shade); crashed trials count as infinitely
far, and a line ends where the quantile falls among them. Green is the settling band: look for who enters it first, and
how far below its edge the error comes to rest. Click a name to hide a controller.""",
    "boxes": """
Each dot is a trial, each box holds the middle half of the trials drawn. Under a box stand the controller's number and how
many of its trials are drawn: missing are those that did not settle (settling time), crashed, or whose step is too small
for an overshoot, so a low box over a small number is no success.""",
    "share": """
Share of all trials settled by each instant. Higher and further left is better; a line that stays below 100&nbsp;%
leaves trials unsettled.""",
    "numbers": f"""
<p class="quiet">Median of the paired differences, its 95&nbsp;% interval, and in how many trials the controller has
less : more. {comparison_tables.INFINITY} where one of the two fails and the other does not.</p>""",
}
