"""A verdict for each claim of the paper, R23 to R30 and H1 to H11.

Verdicts rest on the weights of the last update, what the paper would have flown; the averaged weights stand beside
them and carry no verdict.
"""

import tomllib
from collections.abc import Callable, Collection
from importlib import resources
from typing import Any

from flytune.config import document
from flytune.reproduction import learning, measures
from flytune.reproduction.evidence import Evidence, Flown
from flytune.reproduction.measures import Measured
from flytune.reproduction.study import ROLES
from flytune.reproduction.verdict import Measure, Verdict, decide

MEASURES: dict[str, Callable[[Evidence, Flown], Measured]] = {
    "R23-damping": measures.damping,
    "R23-error": measures.steady_state,
    "R24": measures.order,
    "R25": measures.overshoot,
    "R26": measures.all_settle,
    "R27-variance": learning.variance,
    "R27-survival": learning.survival,
    "R28": learning.efficiency,
    "R29-actuation": measures.actuation,
    "R29-settling": measures.inspection_first,
    "R30": measures.robustness,
}
OF_TRAINING = {"R27-variance", "R27-survival", "R28"}  # nothing is flown, so there is no row for averaged weights


def claims(evidence: Evidence, items: Collection[str] | None = None) -> list[Verdict]:
    """The verdicts, in the order of the paper's items; all of them where `items` is None."""
    words = tomllib.loads((resources.files("flytune.reproduction") / "claims.toml").read_text(encoding="utf-8"))
    return [
        _heuristic(evidence, item, text) if "parameters" in text else _claim(evidence, item, text)
        for item, text in words.items()
        if items is None or item in items
    ]


def _claim(evidence: Evidence, item: str, text: dict[str, Any]) -> Verdict:
    last = MEASURES[item](evidence, "last")
    average = [] if item in OF_TRAINING else _all(MEASURES[item](evidence, "average"))
    reason = text.get("untestable")
    return Verdict(
        item=item,
        claim=text["claim"],
        word="cannot be tested as printed" if reason else decide(last.printed, last.reading),
        reading=text["reading"],
        why=f"{reason[0].upper()}{reason[1:]}. {text['why']}" if reason else text["why"],
        measures=_all(last),
        average=average,
    )


def _all(measured: Measured) -> list[Measure]:
    return [*measured.printed, *measured.reading, *measured.aside]


def _heuristic(evidence: Evidence, item: str, text: dict[str, Any]) -> Verdict:
    """What three presets can say of one parameter: its values, and how many others changed with it."""
    tables = {role: document.plain(evidence.tasks[role]) for role in ROLES}
    rows = []
    for parameter in text["parameters"]:
        values = {role: _look_up(tables[role], parameter) for role in ROLES}
        rows.append(
            Measure(what=f"{parameter}: " + ", ".join(f"{role} {value}" for role, value in values.items()), value=None)
        )
    flat = {
        role: dict(_leaves({key: table[key] for key in ("reward", "termination")})) for role, table in tables.items()
    }
    for role in ("acrobatic", "inspection"):
        paths = sorted(set(flat["baseline"]) | set(flat[role]))
        changed = [path for path in paths if flat["baseline"].get(path) != flat[role].get(path)]
        rows.append(Measure(what=f"parameters in which {role} differs from baseline", value=float(len(changed))))
    return Verdict(
        item=item,
        claim=text["claim"],
        word="cannot be tested as printed",
        reading="One parameter at a time would be needed.",
        why=f"Three presets that differ in many parameters at once cannot show what one of them does. {text['why']}",
        measures=rows,
    )


def _look_up(table: Any, path: str) -> str:
    for name in path.split("."):
        if not isinstance(table, dict) or name not in table:
            return "none"
        table = table[name]
    return str(table)


def _leaves(table: dict[str, Any], path: str = "") -> list[tuple[str, Any]]:
    found = []
    for name, value in table.items():
        found += _leaves(value, f"{path}{name}.") if isinstance(value, dict) else [(f"{path}{name}", value)]
    return found
