"""Rules: which field of the task to edit when the response misses a requirement, and why (paper H1 to H11)."""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import Annotated, Any, Literal

from annotated_types import Gt

from flytune.config import document, nested
from flytune.config.document import Real
from flytune.config.pytree import pytree
from flytune.config.recognise import RULES, misplaced
from flytune.errors import BadInput
from flytune.tables import Table
from flytune.task.task import Task

# symptom -> the measure that misses its requirement, and the direction in which a rule has to move it; in the order in
# which symptoms are treated
SYMPTOMS = {
    "unsettled": ("settled", +1),
    "too slow": ("settling_time", -1),
    "too fast": ("settling_time", +1),
    "violates a constraint": ("constraints_satisfied", +1),
    "overshoots": ("overshoot", -1),
    "inaccurate": ("error", -1),
}
SHARES = ("settled", "constraints_satisfied")  # the measures that are shares of the trials


@pytree
class Rule:
    """One heuristic: while the response has the symptom `when`, move `field` in `direction`."""

    name: str
    source: str = ""
    advice: str = ""  # a hint for the reader instead of an edit; all that follows is left out
    when: Literal["", "too slow", "too fast", "overshoots", "inaccurate", "unsettled", "violates a constraint"] = ""
    field: str = ""
    direction: Literal["", "up", "down"] = ""
    slope: Real = 0.0  # d log(measure) / d log(field), used where no measured sensitivity applies
    largest: Annotated[Real, Gt(1)] = 2.0  # largest factor of one edit
    range: tuple[Real, Real] = (0.0, 1e9)
    requires: tuple[str, ...] = ()  # measures; the rule is not used while one of them misses its requirement
    reason: str = ""

    def problem(self) -> str | None:
        """Why the rule cannot be used, or None."""
        if any("\n" in text for text in (self.name, self.reason, self.source, self.advice)):
            return "reason: holds a line break. Allowed: one line. The same holds for name, source and advice."
        if self.advice:
            return None
        for name in ("when", "field", "direction"):
            if not getattr(self, name):
                return f"{name}: missing. Allowed: a text; only a rule with advice has none."
        sign = SYMPTOMS[self.when][1] * (1 if self.direction == "up" else -1)
        if self.slope * sign <= 0:
            return (
                f"slope: {self.slope:g} is not allowed. Allowed: {'above' if sign > 0 else 'below'} 0, or it does harm."
            )
        if not 0 < self.range[0] < self.range[1]:
            return f"range: {list(self.range)} is not allowed. Allowed: two numbers above 0, the smaller first."
        known = {measure for measure, _ in SYMPTOMS.values()}
        if set(self.requires) - known:
            return f"requires: {list(self.requires)} is not allowed. Allowed: {', '.join(sorted(known))}."
        return None

    @property
    def measure(self) -> str:
        """The measure that the rule changes."""
        return SYMPTOMS[self.when][0]


def load_rules(extra: str | Path | None = None) -> list[Rule]:
    """The rules of flytune and those of the user's TOML file, which replace rules of the same name.

    Raises:
        BadInput: the file cannot be read, or a rule in it cannot be used.
    """
    with resources.as_file(resources.files("flytune.tuning") / "rules.toml") as path:
        rules = {rule.name: rule for rule in _read(path)}
    if extra is not None:
        rules |= {rule.name: rule for rule in _read(Path(extra))}
    return list(rules.values())


def _read(path: Path) -> list[Rule]:
    if line := misplaced(str(path), RULES):
        raise BadInput(f"rules: {line}")
    tables = document.load(path, remedy="Give a TOML file with tables [[rule]].").get("rule")
    if not isinstance(tables, list) or not tables:
        raise BadInput(f"{path}: holds no rule. Allowed: one or more tables [[rule]].")
    return [document.read(Rule, table, f"{path}: rule {number}") for number, table in enumerate(tables, start=1)]


def symptoms(misses: dict[str, float]) -> list[str]:
    """The symptoms that belong to the misses, in the order in which they should be treated."""
    return [name for name, (measure, direction) in SYMPTOMS.items() if misses.get(measure, 0.0) * direction < 0]


def number_at(task: Mapping[str, Any], path: str) -> float | None:
    """The number at a field path of a task's tables; None where the task has no such number."""
    value = nested.look_up(task, path)
    return float(value) if isinstance(value, int | float) and not isinstance(value, bool) else None


def edited(task: Mapping[str, Any], values: Mapping[str, Any], reasons: Mapping[str, str]) -> Task:
    """The task of some tables with other values (by field path), and the reasons for them among its sources.

    A number that is an integer in the tables stays one.

    Raises:
        BadInput: the task cannot have these values.
    """
    tables = dict(task)
    for path, value in values.items():
        is_whole = type(nested.look_up(task, path)) is int
        tables = nested.edit(tables, path, round(value) if is_whole else value)
    tables["sources"] = {**tables.get("sources", {}), **reasons}
    return document.read(Task, tables)


def is_fixed(path: str, fixed: Sequence[str]) -> bool:
    """Whether the user has set a field, or a table above it."""
    return any(path == each or path.startswith(f"{each}.") for each in fixed)


def apply_rule(rule: Rule, value: float, factor: float) -> float:
    """The value times `factor`, within the rule's range and its largest factor, rounded to three digits."""
    limit = math.log(float(rule.largest))
    allowed = math.exp(max(-limit, min(limit, math.log(factor))))
    low, high = map(float, rule.range)
    target = max(low, min(high, value * allowed))
    return float(f"{target:.3g}")


def rules_table(rules: Sequence[Rule]) -> str:
    """The rules as a table for a terminal, and below it the advice that no edit of a single number expresses."""
    titles = ("rule", "when", "edit", "factor at most", "range", "effect, if not measured", "not while", "reason")
    table = Table.plain(titles, [_row(rule) for rule in rules if not rule.advice], underlined=True)
    advice = [f"{rule.name}: {rule.advice} ({rule.source})" for rule in rules if rule.advice]
    return "\n".join([str(table), *(["", "Advice:"] if advice else []), *advice])


def _row(rule: Rule) -> tuple[str, ...]:
    low, high = map(float, rule.range)
    measure = rule.measure.replace("_", " ")
    expected = f"{measure} ~ field^{rule.slope:g}"
    if rule.measure in SHARES:
        expected = "more trials settle" if rule.measure == "settled" else "fewer trials violate a constraint"
    guard = ", ".join(rule.requires).replace("_", " ")
    return (
        rule.name, rule.when, f"{rule.field} {rule.direction}", f"x {rule.largest:g}", f"{low:g} to {high:g}",
        expected, f"{guard} missed" if guard else "", f"{rule.reason} ({rule.source})",
    )  # fmt: skip


def to_dicts(rules: Sequence[Rule]) -> list[dict[str, Any]]:
    """The rules as plain values."""
    return [dataclasses.asdict(rule) for rule in rules]
