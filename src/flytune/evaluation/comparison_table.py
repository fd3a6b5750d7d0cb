"""The comparison in tables and words: a row per controller, a row per metric, and sentences on what sets them apart."""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from flytune.evaluation.difference import METRICS, Difference, Metric
from flytune.evaluation.judge import CHANNELS, Judgement
from flytune.tables import NULL, Cell, Column, Table

LABELS = {"simulator": "world"}  # of fields whose name in the output is older than their name in the code
MAY_DIFFER = ("simulator", "task", "vehicle")  # between controllers whose trials are the same
LONGEST = 30  # characters of a name in the table

NOTE = (
    "Differences are medians over the trials, each with itself: infinite where one controller settles, or flies on, "
    "and the",
    "other does not. Intervals are for these controllers as they are; another training of the same kind would differ "
    "more.",
)

WAYS = {  # field of the judgement -> (how a controller with more of it compares, how one with less)
    "settling_time": ("later", "earlier"),
    "overshoot": ("more", "less"),
    "steady_state_error": ("farther off", "nearer"),
    "rms_error": ("larger", "smaller"),
    "peak_speed": ("faster", "slower"),
    "action_rms": ("harder", "more gently"),
    "action_total_variation": ("more", "less"),
}
WORDS = {  # metric -> (what a controller does, with as much, unit, factor to that unit, decimals)
    "position.settling_time": ("settles", "as early as", " s", 1.0, 2),
    "yaw.settling_time": ("settles in yaw", "as early as", " s", 1.0, 2),
    "position.overshoot": ("overshoots", "as much as", " % of the step", 100.0, 2),
    "position.steady_state_error": ("stays", "as near as", " mm", 1e3, 2),
    "yaw.steady_state_error": ("points", "as near as", " deg", math.degrees(1), 3),
    "peak_speed": ("peaks", "as fast as", " m/s", 1.0, 2),
    "action.rms": ("acts (RMS)", "as hard as", "", 1.0, 4),
    "action.total_variation": ("changes its action per step", "as much as", "", 1.0, 4),
}


TITLES = {  # field of the judgement -> in words
    "settling_time": "settling time",
    "overshoot": "overshoot",
    "steady_state_error": "steady-state error",
    "rms_error": "RMS error",
    "peak_speed": "peak speed",
    "action_rms": "action, RMS",
    "action_total_variation": "action, change",
}
SCALES = {"s": ("s", 1.0), "m": ("mm", 1e3), "rad": ("deg", math.degrees(1)), "m/s": ("m/s", 1.0), "1": ("1", 1.0)}


def title(metric: Metric) -> str:
    """A metric in words."""
    return " ".join(filter(None, [metric.channel, TITLES[metric.field]]))


def unit(metric: Metric) -> tuple[str, float]:
    """The unit a metric is shown in, and its factor."""
    return ("%", 100.0) if metric.field == "overshoot" else SCALES[metric.unit]


@dataclasses.dataclass(frozen=True)
class _Controller:
    """One row of the comparison table."""

    number: int
    judgement: Judgement
    judged: Mapping[str, Any]  # Judgement.to_dict

    @property
    def crossed(self) -> int:
        """Trials that crossed some bound."""
        nobody = np.zeros(self.judgement.trials, dtype=bool)
        return int(np.count_nonzero(np.any([nobody, *self.judgement.violated.values()], axis=0)))


def _settled(channel: str, title: str) -> Column:
    return Column(title, lambda row: row.judgement.settled(channel), group="settled trials    ", width=5)


COLUMNS = (  # spaces at the ends of a heading place it in a terminal
    Column("", lambda row: controller_cell(row.number, row.judgement.name), align="left", width=10),
    *(_settled(channel, channel[:3]) for channel in CHANNELS),
    Column("median", lambda row: row.judged["position"]["settling_time"]["median"], group="settling [s]", decimals=2,
           width=9),
    Column("p95", lambda row: row.judged["position"]["settling_time"]["p95"], group="settling [s]", decimals=2,
           width=8),
    Column("[%]", lambda row: row.judged["position"]["overshoot"]["median"], group="overshoot", decimals=1, scale=100.0,
           width=13),
    Column("[mm]", lambda row: row.judged["position"]["steady_state_error"]["median"], group="final error", decimals=1,
           scale=1e3, width=7),
    Column("[deg]", lambda row: row.judged["axes"]["yaw"]["steady_state_error"]["median"], group="final error",
           decimals=2, scale=math.degrees(1), width=7),
    Column("[m/s]", lambda row: row.judged["peak_speed"]["median"], group="peak", decimals=2, width=8),
    Column("rms", lambda row: row.judged["action"]["rms"], group="action   ", decimals=3, width=7),
    Column("change", lambda row: row.judged["action"]["total_variation"], group="action   ", decimals=4, width=8),
    Column("a bound", lambda row: row.crossed, group="     crossed", width=10),
    Column("crashed", lambda row: row.judged["crashed"], width=9),
)  # fmt: skip


def comparison_table(judgements: Sequence[Judgement]) -> Table:
    """The table of several controllers, one row for each."""
    rows = [_Controller(number, judgement, judgement.to_dict()) for number, judgement in enumerate(judgements, start=1)]
    return Table.of(COLUMNS, rows, style="dense")


def comparison_text(judgements: Sequence[Judgement], reference: int, differences: Sequence[Difference]) -> str:
    """The comparison for a terminal: the table, and beneath it what sets each controller apart from the reference."""
    lines = [conditions(judgements), "", comparison_table(judgements).text()]
    for judgement in judgements:
        found = sentences([one for one in differences if one.name == judgement.name], judgements[reference].name)
        lines += ["", *("    " * (index > 0) + text for index, text in enumerate(found))] if found else []
    return "\n".join([*lines, "", *NOTE])


def differences_table(judgements: Sequence[Judgement], reference: int, differences: Sequence[Difference]) -> Table:
    """Per metric and controller but the reference: the median difference, its interval, and the trials."""
    names = [judgement.name for judgement in judgements]
    others = [Column(f"{n} {name}", align="left") for n, name in enumerate(names, start=1) if n != reference + 1]
    rows = []
    for metric in METRICS:
        symbol, scale = unit(metric)
        found = (_difference_cell(one, scale) for one in differences if one.metric is metric)
        rows.append((f"{title(metric)} [{symbol}]", *found))
    return Table.plain([f"less {names[reference]}", *others], rows, style="dense narrow")


def _difference_cell(difference: Difference, scale: float) -> str:
    left_out = f" ({difference.left_out} left out)" if difference.left_out else ""
    return (
        f"{signed(difference.median * scale)}\n{signed(difference.low * scale)} to {signed(difference.high * scale)}"
        f"\n{difference.better} : {difference.worse}{left_out}"
    )


def signed(value: float) -> str:
    """A difference with its sign, to three digits."""
    if math.isnan(value):
        return NULL
    if math.isinf(value):
        return ("+" if value > 0 else "\N{MINUS SIGN}") + "\N{INFINITY}"
    return f"{value:+.3g}".replace("-", "\N{MINUS SIGN}") if value else "0"


def controller_cell(number: int, name: str) -> Cell:
    """A controller's name: in a terminal short, on a page whole and behind its number, which has its colour."""
    return Cell(text=_short(name), page=name, badge=number)


def conditions(judgements: Sequence[Judgement]) -> str:
    """What all controllers have in common, and who flew what where they do not, in one line."""
    first = judgements[0]
    trials = "the same trial" if first.trials == 1 else f"the same {first.trials} trials"
    text = [
        f"{len(judgements)} controllers over {trials} of {first.duration:g} s, starts {first.initial_conditions}, "
        f"seed {first.seed}"
    ]
    for field in MAY_DIFFER:
        flown = {judgement.name: str(getattr(judgement, field)) for judgement in judgements}
        same = len(set(flown.values())) == 1
        text.append(
            f"{LABELS.get(field, field)} "
            + (flown[first.name] if same else ", ".join(f"{v} ({name})" for name, v in flown.items()))
        )
    return "; ".join(text)


def sentences(differences: Sequence[Difference], against: str) -> list[str]:
    """How a controller differs from the one called `against`, a clause for each metric in `WORDS`; the first is whole.

    The clauses after the first leave out both names.
    """
    told = [difference for difference in differences if difference.metric.name in WORDS]
    return [_clause(difference, _short(against), whole=index == 0) for index, difference in enumerate(told)]


def _clause(difference: Difference, against: str, whole: bool) -> str:
    verb, equal, unit, scale, decimals = WORDS[difference.metric.name]
    more, less = WAYS[difference.metric.field]
    name = f"{_short(difference.name)} " if whole else ""
    middle, low, high = difference.median, difference.low, difference.high
    if not difference.compared:
        return f"{name}{verb}: no trial to compare with {against}"
    better, worse = difference.better, difference.worse
    if middle < 0:  # say it the other way round, so that its numbers are positive
        more, less, middle, low, high, better, worse = less, more, -middle, -high, -low, worse, better

    def amount(value: float) -> str:
        return f"{abs(value) * scale:.{decimals}f}" if math.isfinite(value) else "infinitely"

    if middle == 0:
        said = f"{verb} {equal} {against}"
    else:
        said = f"{verb} {amount(middle)}{unit if math.isfinite(middle) else ''} {more}" + f" than {against}" * whole
    if low >= 0 and middle > 0:
        interval = f"{amount(low)} to {amount(high)}"
    else:
        interval = " to ".join(f"{amount(end)} {more if end > 0 else less}" if end else "0" for end in (low, high))
    interval = "likewise" if math.isinf(low) and low == high else interval
    counts = [f"{more} in {worse} of {difference.compared + difference.left_out} trials"]
    others = {less: better, "equal": difference.tied, "not comparable": difference.left_out}
    counts += [f"{how} in {number}" for how, number in others.items() if number]
    return f"{name}{said} (95 % interval {interval}), {', '.join(counts)}"


def _short(name: str) -> str:
    """A name for the table; of a long one the end, which is where paths differ."""
    return name if len(name) <= LONGEST else "…" + name[1 - LONGEST :]
