"""The report: one self-contained page on what one or several policies fly like, and how they came to."""

import math
from collections.abc import Sequence
from html import escape
from pathlib import Path

from flytune.config.files import check_file, write_text
from flytune.errors import BadInput
from flytune.evaluation import metrics
from flytune.evaluation.evaluate import Evaluation
from flytune.report import page, plots, tables
from flytune.report.learning import ends_that_never_came, learning
from flytune.report.style import listed

SECTIONS = {
    "response": "Step response",
    "spread": "All trials",
    "margins": "Margins",
    "space": "Flights in space",
    "learning": "Learning",
    "task": "Task",
    "about": "About this run",
}


Entry = Evaluation  # one controller to report on


def write_report(path: Path, entries: Sequence[Entry]) -> None:
    """Write the report of one or several policies as one HTML file, whole or not at all.

    Args:
        path: the file; one that is there is replaced.
        entries: the policies, 1 or more, in the order of the page.

    Raises:
        BadInput: no policy, or the file cannot be written.
    """
    if not entries:
        raise BadInput("report: no policy. Allowed: one or more. Name a run directory, a policy file or a controller.")
    check_file(path)
    write_text(path, _page(entries))


def _page(entries: Sequence[Entry]) -> str:
    if len(entries) == 1:
        entry = entries[0]
        return page.page(f"{entry.name}: flytune report", f"<h1>{escape(entry.name)}</h1>{_section(entry, 'p1')}")
    anchors = [f"p{number}" for number in range(1, len(entries) + 1)]
    sections = "".join(
        f'<h2 id="{anchor}">{escape(entry.name)}</h2>{_section(entry, anchor)}'
        for anchor, entry in zip(anchors, entries, strict=True)
    )
    return page.page("flytune report", f"{_comparison(anchors, entries)}{sections}")


def _comparison(anchors: Sequence[str], entries: Sequence[Entry]) -> str:
    """What stands on top of a page of several policies: contents, the table, the overlay, how the tasks differ."""
    contents = "".join(
        f'<li><a href="#{anchor}">{escape(entry.name)}</a></li>' for anchor, entry in zip(anchors, entries, strict=True)
    )
    judged = [(anchor, entry.name, entry.judgement) for anchor, entry in zip(anchors, entries, strict=True)]
    share = plots.settled_share([(entry.name, entry.judgement) for entry in entries])
    return (
        f"<h1>{len(entries)} policies compared</h1><nav><ol>{contents}</ol></nav>"
        f"<h3>Side by side</h3>{tables.comparison_table(judged)}{_CAPTIONS['dash']}"
        f"<h3>Settled by when</h3>{page.drawing(share, _CAPTIONS['share'])}"
        f"<h3>How their tasks differ</h3>{tables.differences_table([(entry.name, entry.task) for entry in entries])}"
    )


def _section(entry: Entry, anchor: str) -> str:
    """All there is to say about one policy."""
    parts = {
        "response": _response(entry),
        "spread": page.drawing(plots.spread(entry.judgement), _CAPTIONS["spread"]),
        "margins": page.drawing(plots.margins(entry.flights, entry.judgement), _CAPTIONS["margins"]),
        "space": page.drawing(plots.flights_3d(entry.flights), _CAPTIONS["space"]),
        "learning": _learning(entry),
        "task": "<p>Every number of the task, its unit, what is allowed, and where it comes from.</p>"
        f"{tables.task_listing(entry.task)}",
        "about": tables.definitions(entry.about) if entry.about else '<p class="empty">Nothing is known of it.</p>',
    }
    links = "".join(f'<a href="#{anchor}-{key}">{SECTIONS[key]}</a>' for key in parts)
    body = "".join(f'<h3 id="{anchor}-{key}">{SECTIONS[key]}</h3>{html}' for key, html in parts.items())
    flown = f"on {entry.judgement.task}, vehicle {entry.judgement.vehicle}, world {entry.judgement.simulator}"
    verdict = tables.verdict(entry.judgement)
    return f'<p class="quiet">{escape(flown)}</p><p class="lead">{verdict}</p><nav>{links}</nav>{body}'


def _response(entry: Entry) -> str:
    figure = plots.response(entry.flights, entry.judgement, entry.task)
    return (
        f"{tables.response_table(entry.judgement)}{_CAPTIONS['dash']}"
        f"{tables.facts(entry.judgement, entry.flights.speed_bound)}{page.drawing(figure, _CAPTIONS['response'])}"
    )


def _learning(entry: Entry) -> str:
    caption = _CAPTIONS["learning"]
    never = ends_that_never_came(entry.metrics)
    if never:
        caption += f" No episode was ended by {escape(listed(never))}."
    return page.drawing(learning(entry.metrics), caption)


_CAPTIONS = {
    "dash": f"""
<p class="quiet">Quantiles are over all trials; one that failed counts as infinite, and {tables.DASH} says that the
quantile falls among those.</p>""",
    "share": """
Higher and further left is better. A line that stays below 100&nbsp;% belongs to a policy that leaves trials
unsettled.""",
    "response": f"""
The first trials of the evaluation. A dot marks the instant from which a trial stays in the settling band (green,
±&nbsp;{metrics.POSITION_BAND:g}&nbsp;m and ±&nbsp;{math.degrees(metrics.YAW_BAND):g}&nbsp;deg); dashed is the target,
red are the bounds of the task, dotted are trials that crashed. Look for a dot on every curve, for curves that cross
the target (overshoot), and, close up, for offsets that stay.""",
    "spread": """
Each dot is a trial, each box holds the middle half of the trials drawn; under it stands how many of all these are.
Missing are trials that did not settle (settling time), that crashed (all three), or whose step is too small for an
overshoot. A box that is a line at zero overshoot is a response that never passes its target.""",
    "margins": """
How much of each bound of the task is left, over all trials, the tightest bound first. At the red line the bound is
reached, below it training would have ended the episode. A margin that comes near the line belongs to a bound
that holds the controller back; a bound whose margin stays far above it does not shape the flight.""",
    "space": """
Turn it by dragging. Dots are starts, the red diamond is the target. Look for detours, and for flights that come in
from one side only.""",
    "learning": """
Look for a reward that has stopped rising, for a term that others outweigh (a flat line far below its weight), and for
terminations that die out; click a name to hide its line.""",
}
