"""The comparison as text for a terminal: a row per controller, then the paired differences in plain words."""

import math
from collections.abc import Sequence

import numpy as np

from flytune.evaluation.difference import Difference
from flytune.evaluation.judge import CHANNELS, Judgement

LABELS = {"simulator": "world"}  # of fields whose name in the output is older than their name in the code
MAY_DIFFER = ("simulator", "task", "vehicle")  # between controllers whose trials are the same
LONGEST = 30  # characters of a name in the table

HEADER = (
    "       settled trials         settling [s]    overshoot   final error    peak      action        crossed",
    "    x    y    z  yaw  pos   median     p95          [%]   [mm]  [deg]   [m/s]    rms  change   a bound  crashed",
)
NOTE = (
    "Differences are medians over the trials, each with itself: infinite where one controller settles, or flies on, and the",
    "other does not. Intervals are for these controllers as they are; another training of the same kind would differ more.",
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


def comparison_table(judgements: Sequence[Judgement], reference: int, differences: Sequence[Difference]) -> str:
    """The table of all controllers, and beneath it what sets each of them apart from the reference."""
    against = judgements[reference].name
    width = max(10, *(len(_short(judgement.name)) for judgement in judgements))
    lines = [conditions(judgements), "", *(" " * width + line for line in HEADER)]
    lines += [f"{_short(judgement.name):<{width}}{_row(judgement)}" for judgement in judgements]
    for judgement in judgements:
        found = sentences([one for one in differences if one.name == judgement.name], against)
        lines += ["", *("    " * (index > 0) + text for index, text in enumerate(found))] if found else []
    return "\n".join([*lines, "", *NOTE])


def _row(judgement: Judgement) -> str:
    """One line of the table, under HEADER."""
    told = judgement.to_dict()
    position, yaw, action = told["position"], told["axes"]["yaw"], told["action"]
    settling = position["settling_time"]
    crossed = np.any([np.zeros(judgement.trials, dtype=bool), *judgement.violated.values()], axis=0)
    return (
        f"{''.join(f'{judgement.settled(channel):>5}' for channel in CHANNELS)}"
        f"{_number(settling['median'], 2):>9}{_number(settling['p95'], 2):>8}"
        f"{_number(position['overshoot']['median'], 1, 100.0):>13}"
        f"{_number(position['steady_state_error']['median'], 1, 1e3):>7}"
        f"{_number(yaw['steady_state_error']['median'], 2, math.degrees(1)):>7}"
        f"{_number(told['peak_speed']['median'], 2):>8}"
        f"{_number(action['rms'], 3):>7}{_number(action['total_variation'], 4):>8}"
        f"{np.count_nonzero(crossed):>10}{told['crashed']:>9}"
    )


def conditions(judgements: Sequence[Judgement]) -> str:
    """What all controllers have in common, and who flew what where they do not, in one line."""
    first = judgements[0]
    trials = "the same trial" if first.trials == 1 else f"the same {first.trials} trials"
    text = [
        f"{len(judgements)} controllers over {trials} of {first.duration:g} s, starts {first.initial_conditions}, seed {first.seed}"
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
    """How a controller differs from the one called `against`, a clause for each metric that has words; the first is whole.

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


def _number(value: float | None, decimals: int, scale: float = 1.0) -> str:
    return "-" if value is None else f"{value * scale:.{decimals}f}"
