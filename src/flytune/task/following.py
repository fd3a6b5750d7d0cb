"""Fields of a task that follow its dials: which may, what is refused, and their values at a setting."""

import itertools
import math
from collections.abc import Iterator, Mapping
from typing import Any

from flytune.config import nested
from flytune.config.formula import FUNCTIONS, Formula
from flytune.errors import BadInput
from flytune.task.dial import Dial, Input, Setting

# parts whose fields may follow a dial
FOLLOWING = ("target", "noise", "reward", "termination", "vehicle", "duration", "horizon")
MOST_DIALS = 4  # all their settings together are checked
CHECKED = {1: 9, 2: 5, 3: 4, 4: 3}  # number of dials -> settings of each at which a task is checked


def problem_of_dials(
    dials: Mapping[str, Dial], follow: Mapping[str, Formula], inputs: Mapping[str, Input]
) -> str | None:
    """What makes the dials of a task and what follows them impossible, or None."""
    if len(dials) > MOST_DIALS:
        return f"dial: {len(dials)} dials are not allowed. Allowed: up to {MOST_DIALS}."
    if not dials and (follow or inputs):
        return (
            "dial: no dial, though `follow` or `input` needs one. Allowed: one or more tables [dial.NAME]; or "
            "follow=none and input=none."
        )
    for name in dials:
        if not name.isidentifier() or name in FUNCTIONS:
            return f"dial.{name}: cannot be used in a formula. Allowed: letters, digits and _, no name of a function."
    formulas = {f"follow.{path}": formula for path, formula in follow.items()}
    formulas |= {f"input.{name}.value": each.value for name, each in inputs.items()}
    for where, formula in formulas.items():
        try:
            unknown = formula.names() - set(dials)
        except ValueError as error:
            return f"{where}: {str(formula)[:60]!r}: {error}."
        if unknown:
            return f"{where}: {min(unknown)} is no dial. Allowed: {', '.join(dials)}."
    for path in follow:
        if path.split(".")[0] not in FOLLOWING:
            return f"follow.{path}: cannot follow a dial. Allowed: a field of {', '.join(FOLLOWING)}."
    return None


def check_given(follow: Mapping[str, Formula], tables: Mapping[str, Any], given: Mapping[str, Any], where: str) -> None:
    """Refuse a file that gives a field another value than the formula that it follows.

    Args:
        follow: field path -> its formula.
        tables: of the task, its dials at their defaults.
        given: what the file says.
        where: its name.

    Raises:
        BadInput: the field, its value and its formula.
    """
    for path, formula in follow.items():
        value, now = nested.look_up(given, path), nested.look_up(tables, path)
        same = isinstance(value, int | float) and math.isclose(value, now, rel_tol=1e-6)
        if value is not None and not same:
            raise BadInput(
                f"{where}: {path}: {value} is not allowed, since it follows the dials as {formula}, which is {now:g} "
                "at their defaults. Leave it out, or change its formula in [follow]."
            )


def settings_to_check(dials: Mapping[str, Dial]) -> Iterator[dict[str, float]]:
    """Settings from end to end of all dials together, at which every value of a task has to be allowed."""
    grids = [dial.trained_grid(CHECKED[len(dials)]) for dial in dials.values()]
    return (dict(zip(dials, values, strict=True)) for values in itertools.product(*grids))


def tables_at(tables: Mapping[str, Any], setting: Setting, prefix: str = "") -> dict[str, Any]:
    """The tables of the fixed task at a setting of all dials.

    Args:
        tables: of the task, with `follow` and `input`.
        setting: the value of each dial.
        prefix: of a message.

    Raises:
        BadInput: a formula has no value there, or a field that follows does not exist.
    """
    fixed = {key: value for key, value in tables.items() if key not in ("dial", "follow", "input")}
    for path, formula in tables["follow"].items():
        if nested.look_up(fixed, path) is None or isinstance(nested.look_up(fixed, path), dict):
            raise BadInput(f"{prefix}follow.{path}: the task has no such number. Allowed: the path of a field.")
        value = _value(formula, setting, f"{prefix}follow.{path}")
        fixed = nested.edit(fixed, path, math.ceil(value) if path == "horizon" else value)  # of whole steps
    for name, each in tables["input"].items():
        _value(each["value"], setting, f"{prefix}input.{name}.value")
    return fixed


def _value(formula: str, setting: Setting, where: str) -> float:
    try:
        return Formula(formula).value(setting)
    except (ArithmeticError, ValueError) as error:
        raise BadInput(f"{where}: {formula} has no value at {words(setting)} ({error}).") from None


def words(setting: Setting) -> str:
    """A setting as a person writes it."""
    return ", ".join(f"{name} {value:g}" for name, value in setting.items())
