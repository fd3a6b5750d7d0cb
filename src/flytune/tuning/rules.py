"""Rules: which field of the task to edit when something is missing of the response, and why (paper H1 to H11)."""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import Annotated, Any, Literal

from annotated_types import Gt

from flytune.config import document
from flytune.config.document import Real
from flytune.config.pytree import pytree
from flytune.errors import BadInput

# what can be missing -> the measure it is of, and the sign of what the rule is to do to it
CONDITIONS = {
    "too slow": ("settling_time", -1),
    "too fast": ("settling_time", +1),
    "overshoots": ("overshoot", -1),
    "inexact": ("error", -1),
    "unsettled": ("settled", +1),
    "breaks a bound": ("kept", +1),
}


@pytree
class Rule:
    """One heuristic: while `when` is true of the response, move `field` in `direction`.

    Errors of a rule are said when it is read: the slope has to promise what the condition wants.
    """

    name: str
    source: str = ""
    advice: str = ""  # instead of all that follows: a rule for the reader, that no number's edit expresses
    when: Literal["", "too slow", "too fast", "overshoots", "inexact", "unsettled", "breaks a bound"] = ""
    field: str = ""
    direction: Literal["", "up", "down"] = ""
    slope: Real = 0.0  # d log(measure) / d log(field) where nothing was measured
    largest: Annotated[Real, Gt(1)] = 2.0  # factor of one edit
    range: tuple[Real, Real] = (0.0, 1e9)
    spares: tuple[str, ...] = ()
    says: str = ""

    def problem(self) -> str | None:
        """What makes the rule impossible, or None."""
        if any("\n" in text for text in (self.name, self.says, self.source, self.advice)):
            return "says: holds a line break. Allowed: one line, as for name, source and advice."
        if self.advice:
            return None
        for name in ("when", "field", "direction"):
            if not getattr(self, name):
                return f"{name}: missing. Allowed: a text; only a rule with advice has none."
        sign = CONDITIONS[self.when][1] * (1 if self.direction == "up" else -1)
        if self.slope * sign <= 0:
            return (
                f"slope: {self.slope:g} is not allowed. Allowed: {'above' if sign > 0 else 'below'} 0, or it does harm."
            )
        if not 0 < self.range[0] < self.range[1]:
            return f"range: {list(self.range)} is not allowed. Allowed: two numbers above 0, the smaller first."
        known = {measure for measure, _ in CONDITIONS.values()}
        if set(self.spares) - known:
            return f"spares: {list(self.spares)} is not allowed. Allowed: {', '.join(sorted(known))}."
        return None

    @property
    def measure(self) -> str:
        """The measure that the rule is to change."""
        return CONDITIONS[self.when][0]


def load_rules(extra: Path | None = None) -> list[Rule]:
    """flytune's rules, and after them those of a TOML file of the user's own, which replace rules of the same name.

    Raises:
        BadInput: the file cannot be read, or a rule in it makes no sense.
    """
    with resources.as_file(resources.files("flytune.tuning") / "rules.toml") as path:
        rules = {rule.name: rule for rule in _read(path)}
    if extra is not None:
        rules |= {rule.name: rule for rule in _read(extra)}
    return list(rules.values())


def _read(path: Path) -> list[Rule]:
    tables = document.load(path).get("rule")
    if not isinstance(tables, list) or not tables:
        raise BadInput(f"{path}: holds no rule. Allowed: one or more tables [[rule]].")
    return [document.read(Rule, table, f"{path}: rule {number}") for number, table in enumerate(tables, start=1)]


def conditions(misses: dict[str, float]) -> list[str]:
    """Which conditions are true of what is missing, in the order in which they are best cured."""
    found = []
    if "settled" in misses:
        found.append("unsettled")
    if "settling_time" in misses:
        found.append("too slow" if misses["settling_time"] > 0 else "too fast")
    for measure, condition in (("kept", "breaks a bound"), ("overshoot", "overshoots"), ("error", "inexact")):
        if measure in misses:
            found.append(condition)
    return found


def field_of(task: Mapping[str, Any], path: str) -> float | None:
    """The number at a field path of a task's tables; None where the task has no such number."""
    number = _number_at(task, path)
    return None if number is None else float(number)


def is_whole(task: Mapping[str, Any], path: str) -> bool:
    """Whether the number at a field path of a task's tables is a whole one, and has to stay so."""
    return isinstance(_number_at(task, path), int)


def _number_at(task: Mapping[str, Any], path: str) -> int | float | None:
    node: Any = task
    for part in path.split("."):
        node = node.get(part) if isinstance(node, Mapping) else None
    return node if isinstance(node, int | float) and not isinstance(node, bool) else None


def is_fixed(path: str, fixed: Sequence[str]) -> bool:
    """Whether the user has set a field, or a table above it."""
    return any(path == each or path.startswith(f"{each}.") for each in fixed)


def moved(rule: Rule, value: float, factor: float) -> float:
    """The field's value times `factor`, within the rule's range and its largest step, to three digits."""
    limit = math.log(float(rule.largest))
    step = math.exp(max(-limit, min(limit, math.log(factor))))
    low, high = map(float, rule.range)
    target = max(low, min(high, value * step))
    return float(f"{target:.3g}")


def rules_table(rules: Sequence[Rule]) -> str:
    """The rules as a table for a terminal, and below it the advice that is no single number's edit."""
    rows = [("rule", "when", "edit", "step at most", "within", "expects, if unmeasured", "not while", "because")]
    rows += [_row(rule) for rule in rules if not rule.advice]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = ["  ".join(text.ljust(width) for text, width in zip(row, widths, strict=True)).rstrip() for row in rows]
    advice = [f"{rule.name}: {rule.advice} ({rule.source})" for rule in rules if rule.advice]
    return "\n".join([lines[0], "-" * len(lines[0]), *lines[1:], *(["", "Advice:"] if advice else []), *advice])


def _row(rule: Rule) -> tuple[str, ...]:
    low, high = map(float, rule.range)
    measure = rule.measure.replace("_", " ")
    expects = f"{measure} ~ field^{rule.slope:g}"
    if rule.measure in ("settled", "kept"):
        expects = "more trials settle" if rule.measure == "settled" else "fewer trials cross a bound"
    guard = ", ".join(rule.spares).replace("_", " ")
    return (
        rule.name, rule.when, f"{rule.field} {rule.direction}", f"x {rule.largest:g}", f"{low:g} to {high:g}",
        expects, f"{guard} missed" if guard else "", f"{rule.says} ({rule.source})",
    )  # fmt: skip


def to_dicts(rules: Sequence[Rule]) -> list[dict[str, Any]]:
    """The rules as plain values."""
    return [dataclasses.asdict(rule) for rule in rules]
