"""The comparison in tables and words: a row per controller, a row per metric, and sentences on their differences."""

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from flytune.evaluation.difference import Difference
from flytune.evaluation.judge import CHANNELS, Judgement
from flytune.evaluation.path_table import path_tables
from flytune.tables import NULL, Cell, Column, Table

if TYPE_CHECKING:
    from flytune.evaluation.comparison import Comparison

LABELS = {"simulator": "world"}  # of fields whose name in the output is older than their name in the code
MAY_DIFFER = ("simulator", "task", "vehicle")  # between controllers whose trials are the same
LONGEST = 30  # characters of a name in the table

NOTE = (
    "Differences are medians over the trials, each with itself. One that has no number, since one controller settles, "
    "or flies",
    "on, and the other does not, counts as infinite. Intervals are for these controllers as they are; another training "
    "of the same",
    "kind would differ more.",
)

COLUMNS = (  # spaces at the ends of a heading place it in a terminal
    Column("", lambda row: row["controller"], align="left", width=10),
    *(Column(channel[:3], lambda row, channel=channel: row["settled"][channel], group="settled trials    ", width=5)
      for channel in CHANNELS),
    Column("median", lambda row: row["position"]["settling_time"]["median"], group="settling [s]", decimals=2, width=9),
    Column("p95", lambda row: row["position"]["settling_time"]["p95"], group="settling [s]", decimals=2, width=8),
    Column("[%]", lambda row: row["position"]["overshoot"]["median"], group="overshoot", decimals=1, scale=100.0,
           width=13),
    Column("[mm]", lambda row: row["position"]["steady_state_error"]["median"], group="final error", decimals=1,
           scale=1e3, width=7),
    Column("[deg]", lambda row: row["axes"]["yaw"]["steady_state_error"]["median"], group="final error", decimals=2,
           scale=math.degrees(1), width=7),
    Column("[m/s]", lambda row: row["peak_speed"]["median"], group="peak", decimals=2, width=8),
    Column("rms", lambda row: row["action"]["rms"], group="action   ", decimals=3, width=7),
    Column("change", lambda row: row["action"]["total_variation"], group="action   ", decimals=4, width=8),
    Column("a bound", lambda row: row["crossed"], group="     crossed", width=10),
    Column("crashed", lambda row: row["crashed"], width=9),
)  # fmt: skip


def comparison_table(judgements: Sequence[Judgement]) -> Table:
    """The table of several controllers, one row for each."""
    return Table.of(COLUMNS, [_row(*numbered) for numbered in enumerate(judgements, start=1)], style="dense")


def _row(number: int, judgement: Judgement) -> dict:
    crossed = np.logical_or.reduce([np.zeros(judgement.trials, dtype=bool), *judgement.violated.values()])
    return judgement.to_dict() | {
        "controller": controller_cell(number, judgement.name),
        "settled": {channel: judgement.settled(channel) for channel in CHANNELS},
        "crossed": int(np.count_nonzero(crossed)),
    }


def comparison_text(comparison: "Comparison") -> str:
    """The comparison for a terminal: the table, and beneath it how each controller differs from the reference."""
    lines = [conditions(comparison), "", comparison_table(comparison.judgements).text()]
    for table in path_tables([judgement.to_dict() for judgement in comparison.judgements]):
        lines += ["", table.text()]
    for first, *others in sentences(comparison):
        lines += ["", first, *(f"    {text}" for text in others)]
    return "\n".join([*lines, "", *NOTE])


def differences_table(comparison: "Comparison") -> Table:
    """Per metric and controller but the reference: the median difference, its interval, and the trials."""
    names, reference = comparison.names, comparison.reference
    others = [f"{number} {name}" for number, name in enumerate(names, start=1) if number != reference + 1]
    rows = []
    for metric in comparison.metrics:
        unit, scale = metric.shown
        found = (_difference_cell(one, scale) for one in comparison.differences if one.metric is metric)
        rows.append((f"{metric.title} [{unit}]", *found))
    return Table.plain([f"less {names[reference]}", *others], rows, style="dense narrow")


def _difference_cell(difference: Difference, scale: float) -> str:
    left_out = f" ({difference.left_out} left out)" if difference.left_out else ""
    median, low, high = (signed(value * scale) for value in (difference.median, difference.low, difference.high))
    return f"{median}\n{low} to {high}\n{difference.better} : {difference.worse}{left_out}"


def signed(value: float) -> str:
    """A difference with its sign, to three digits."""
    if math.isnan(value):
        return NULL
    text = f"{value:+.3g}" if value else "0"
    return text.replace("-", "\N{MINUS SIGN}").replace("inf", "\N{INFINITY}")


def controller_cell(number: int, name: str) -> Cell:
    """A controller's name: in a terminal short, on a page whole and behind its number, which has its colour."""
    return Cell(text=_short(name), page=name, badge=number)


def conditions(comparison: "Comparison") -> str:
    """The conditions that all controllers share, and those in which they differ, in one line."""
    judgements = comparison.judgements
    first = judgements[0]
    trials = "the same trial" if first.trials == 1 else f"the same {first.trials} trials"
    text = [
        f"{len(judgements)} controllers over {trials} of {first.duration:g} s, starts {first.initial_conditions}, "
        f"seed {first.seed}"
    ]
    for field in MAY_DIFFER:
        flown = {judgement.name: str(getattr(judgement, field)) for judgement in judgements}
        same = len(set(flown.values())) == 1
        values = flown[first.name] if same else ", ".join(f"{value} ({name})" for name, value in flown.items())
        text.append(f"{LABELS.get(field, field)} {values}")
    if first.changes:
        met = ", ".join(f"{path}={value}" for path, value in first.changes.items())
        text.append(f"every controller meets {met}, and was told otherwise")
    for judgement in judgements:
        if judgement.made_for:
            text.append(
                f"{judgement.name} was trained on {judgement.made_for}: its actions are relative to the hover speed of "
                f"{judgement.vehicle}, which flies"
            )
    return "; ".join(text)


def sentences(comparison: "Comparison") -> list[list[str]]:
    """How each controller differs from the reference, a clause for each metric that has a verb.

    The first clause of a controller is whole; the others leave out both names.
    """
    against = _short(comparison.names[comparison.reference])
    spoken = [difference for difference in comparison.differences if difference.metric.verb]
    found = [[one for one in spoken if one.name == name] for name in comparison.names]
    return [[_clause(one, against, whole=one is clauses[0]) for one in clauses] for clauses in found if clauses]


def _clause(difference: Difference, against: str, whole: bool) -> str:
    metric, name = difference.metric, f"{_short(difference.name)} " if whole else ""
    if not difference.compared:
        return f"{name}has no trial whose {metric.title} can be compared with that of {against}"
    trials = difference.compared + difference.left_out
    if 2 * difference.both_failed > difference.compared:
        pair = f"{name}and {against}: " if whole else ""
        return f"{pair}{metric.neither} in {difference.both_failed} of {trials} trials"
    if math.isinf(difference.median):
        worse, better = metric.outcomes
        mine, other = (worse, better) if difference.median > 0 else (better, worse)
        about = "" if metric.field == "settling_time" else f"{metric.title}: "  # whose sentence would be of the crash
        return f"{about}{name}{mine} where {against} {other}{_interval(difference)}, {_counts(difference)}"
    unit, scale = metric.shown
    unit = {"1": "", "%": " % of the step"}.get(unit, f" {unit}")
    said = f"{metric.equal} {against}"
    if difference.median:
        size = f"{abs(difference.median) * scale:.{metric.decimals}f}{unit}"
        said = f"{size} {metric.ways[difference.median < 0]}" + f" than {against}" * whole
    return f"{name}{metric.verb} {said}{_interval(difference)}, {_counts(difference)}"


def _interval(difference: Difference) -> str:
    """The 95 % interval in brackets; empty where it has no number at either end."""
    metric, low, high = difference.metric, difference.low, difference.high
    if difference.median < 0:  # say it the other way round, so that its numbers are positive
        low, high = -high, -low
    scale, alone = metric.shown[1], low >= 0 and difference.median != 0  # alone: it lies on one side, which was said

    def end(value: float) -> str:
        way = "" if alone or not value else f" {metric.ways[(value < 0) != (difference.median < 0)]}"
        return f"{abs(value) * scale:.{metric.decimals}f}{way}" if value else "0"

    if math.isinf(low) and math.isinf(high):
        return ""
    text = f"from {end(low)} on" if math.isinf(high) else f"up to {end(high)}" if math.isinf(low) else ""
    return f" (95 % interval {text or f'{end(low)} to {end(high)}'})"


def _counts(difference: Difference) -> str:
    """In how many trials a controller has more, and less, than the other one; the way of the median first."""
    (more, less), better, worse = difference.metric.ways, difference.better, difference.worse
    (first, number), other = (
        ((less, better), (more, worse)) if difference.median < 0 else ((more, worse), (less, better))
    )
    counts = [f"{first} in {number} of {difference.compared + difference.left_out} trials"]
    equal = difference.tied - difference.both_failed
    others = (other, ("equal", equal), ("neither", difference.both_failed), ("not comparable", difference.left_out))
    return ", ".join([*counts, *(f"{how} in {count}" for how, count in others if count)])


def _short(name: str) -> str:
    """A name for the table; of a long one the end, which is where paths differ."""
    return name if len(name) <= LONGEST else "…" + name[1 - LONGEST :]
