"""Type, unit and range of a dataclass's field from its annotation, `Annotated[Real, Ge(0), Unit("m/s")]`, in words."""

import dataclasses
import difflib
import math
import types
from collections.abc import Callable, Iterable, Mapping
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

import annotated_types
from pydantic import AfterValidator, AllowInfNan, BeforeValidator, Strict

from flytune.config.formula import Formula

LARGEST, SMALLEST = 3e38, 1.2e-38  # of single precision, without subnormal numbers


def _single(value: float) -> float:
    """The number, which single precision has to hold."""
    if value and not SMALLEST <= abs(value) <= LARGEST:
        raise ValueError(f"numbers are single precision, 0 or {SMALLEST:g} to {LARGEST:g} in size")
    return value


def _computed(value: Any) -> Any:
    """Refuse a value in a file for a field that is `derived`."""
    raise ValueError("it is computed from the other fields, leave it out")


Derived = Annotated[Any, BeforeValidator(_computed)]
Real = Annotated[float, Strict(), AllowInfNan(False), AfterValidator(_single)]


def whole(value: Any) -> Any:
    """The whole number that a float stands for, 100 for 1e2; anything else as it is."""
    return int(value) if isinstance(value, float) and value.is_integer() else value


Whole = Annotated[int, Strict(), BeforeValidator(whole)]
Vector = tuple[Real, Real, Real]


def allowed(annotation: Any) -> str:
    """The values a field accepts, in words."""
    base, details = unwrap(annotation)
    if get_origin(base) is Literal:
        return "one of " + ", ".join(map(str, get_args(base)))
    if is_union(base):
        options = [option for option in get_args(base) if option is not type(None)]
        return " or ".join(dict.fromkeys(allowed(Annotated[option, "", *details]) for option in options))
    if dataclasses.is_dataclass(base) or get_origin(base) is dict:
        return "a table"
    if get_origin(base) is tuple:
        items = [item for item in get_args(base) if item is not Ellipsis]
        length = f"{len(items)} values" if len(items) == len(get_args(base)) else "a list"
        return f"{length}, each {allowed(items[0])}"
    lower = upper = alone = ""  # alone: the words for a bound without one on the other side
    for detail in details:
        match detail:
            case annotated_types.Gt(gt=bound):
                lower = alone = f"above {bound}"
            case annotated_types.Ge(ge=bound):
                lower, alone = f"{bound}", f"{bound} or more"
            case annotated_types.Lt(lt=bound):
                upper = alone = f"below {bound}"
            case annotated_types.Le(le=bound):
                upper, alone = f"{bound}", f"{bound} or less"
    other = {float: "a finite number", int: "", str: "text", bool: "true or false", Formula: "a formula"}.get(
        base, str(base)
    )
    text = f"{lower} to {upper}" if lower and upper else alone or other
    return ", ".join(filter(None, ("a whole number" if base is int else "", text)))


def unit_of(kind: Any, data: Mapping[str, Any], path: str) -> str:
    """The unit of the field at a dotted path of a dataclass's tables; empty where it has none, or there is no field."""
    annotation, node = kind, data
    for name in path.split("."):
        annotation = step_into(annotation, name, node)
        node = node.get(name, {}) if isinstance(node, Mapping) else {}
    return "" if annotation is None else unit_text(annotation)


def nearest(name: str, options: Iterable[str]) -> str | None:
    """The option spelled most like `name`, or that shares all words of the shorter one; None where nothing is near."""
    options = list(options)
    if found := difflib.get_close_matches(name, options, n=1, cutoff=0.75):
        return found[0]
    if same := [each for each in options if sorted(each) == sorted(name)]:  # two letters have changed places
        return same[0]
    words = set(name.split("_"))
    shared = [each for each in options if words <= set(each.split("_")) or set(each.split("_")) <= words]
    return min(shared, key=len, default=None)


def unit_text(annotation: Any, before: str = "") -> str:
    """The unit of an annotation with `before` in front of it; empty where it has none."""
    base, details = unwrap(annotation)
    if get_origin(base) is tuple:
        return unit_text(get_args(base)[0], before)
    if is_union(base) and not any(isinstance(detail, annotated_types.Unit) for detail in details):
        return next(filter(None, (unit_text(option, before) for option in get_args(base))), "")
    for detail in details:
        if isinstance(detail, annotated_types.Unit) and detail.unit != "1":
            return before + detail.unit
    return ""


def reason(annotation: Any) -> str:
    """Why a field has its range, in brackets after a space; empty where its type does not say."""
    base, details = unwrap(annotation)
    if get_origin(base) is tuple:
        return reason(get_args(base)[0])
    return next((f" ({each.documentation})" for each in details if isinstance(each, annotated_types.DocInfo)), "")


OTHER_UNITS = {  # unit of a field -> other units that a number may be in by mistake, each with its factor
    "rad": {"deg": math.pi / 180},
    "rad/s": {"deg/s": math.pi / 180},
    "deg": {"rad": 180 / math.pi},
    "deg/s": {"rad/s": 180 / math.pi},
    "s": {"ms": 1e-3},
    "m": {"mm": 1e-3},
    "m/s^2": {"cm/s^2": 1e-2},
    "1": {"percent": 1e-2},
}


def slip(annotation: Any, value: Any, accepts: Callable[[float], bool]) -> str:
    """What a number out of range would be if it were in another unit: a hint after a space, or nothing.

    Args:
        annotation: of the field.
        value: that was refused.
        accepts: whether the field accepts a number.
    """
    unit = next((each.unit for each in unwrap(annotation)[1] if isinstance(each, annotated_types.Unit)), "")
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value) or not value:
        return ""
    for other, factor in OTHER_UNITS.get(unit, {}).items():
        if accepts(value * factor):
            return f" Is it in {other}? Then write {value * factor:.4g}."
    return ""


def list_like(annotation: Any, value: Any, accepts: Callable[[Any], bool]) -> list[Any] | None:
    """A list that a field accepts and that is like what was given: cut, or filled up; None where there is none.

    Args:
        annotation: of the field, which takes a list of numbers.
        value: that was refused: a list, one number, or a text such as "0,0,1".
        accepts: whether the field accepts a list.
    """
    base = inner_type(annotation)
    items = [item for item in get_args(base) if item is not Ellipsis]
    if get_origin(base) is not tuple or not is_number(items[0]):
        return None
    if isinstance(value, str):
        value = [_number(part) for part in value.strip("[](){} ").replace(",", " ").replace(";", " ").split()]
    given = list(value) if isinstance(value, list | tuple) else [value]
    count = len(items) if len(items) == len(get_args(base)) else len(given)
    for filler in (0, *given[-1:], 1):
        example = (given + [filler] * count)[:count]
        if example and accepts(example):
            return example
    return None


def _number(text: str) -> Any:
    try:
        return whole(float(text))
    except (ValueError, OverflowError):
        return text


def is_number(annotation: Any) -> bool:
    """Whether a field takes a number."""
    return unwrap(annotation)[0] in (int, float)


def inner_type(annotation: Any) -> Any:
    """The type of a field without its Annotated layers, and of an optional one without None."""
    base, _ = unwrap(annotation)
    kept = [option for option in get_args(base) if option is not type(None)] if is_union(base) else []
    return unwrap(kept[0])[0] if len(kept) == 1 else base


def is_optional(annotation: Any) -> bool:
    """Whether a field may be left empty."""
    base, _ = unwrap(annotation)
    return is_union(base) and type(None) in get_args(base)


def is_named(annotation: Any) -> bool:
    """Whether a field holds entries under names that the user chooses."""
    return get_origin(unwrap(annotation)[0]) is dict


def unwrap(annotation: Any) -> tuple[Any, list[Any]]:
    """A type without its Annotated layers, and the contents of those layers."""
    details: list[Any] = []
    while get_origin(annotation) is Annotated:
        annotation, *more = get_args(annotation)
        details += more
    return annotation, details


def annotations(kind: Any) -> dict[str, Any]:
    """The annotation of each field of a dataclass that a file may hold, with `Annotated`."""
    hints = get_type_hints(kind, include_extras=True)
    fields = getattr(kind, "__dataclass_fields__", {})
    return {name: hint for name, hint in hints.items() if not (name in fields and fields[name].metadata.get("derived"))}


def step_into(annotation: Any, name: Any, data: Any) -> Any:
    """The annotation one step further down a path, or None where there is no such field."""
    base, _ = unwrap(annotation)
    if is_union(base):
        base = variant_of(base, data) or next((each for each in get_args(base) if get_origin(each) is tuple), None)
    if dataclasses.is_dataclass(base):
        return annotations(base).get(name)
    if get_origin(base) is dict:
        return get_args(base)[1]
    if get_origin(base) is tuple:
        return get_args(base)[0]
    return None


def is_union(base: Any) -> bool:
    """Whether a type is a union."""
    return get_origin(base) in (Union, types.UnionType)


def variant_of(union: Any, data: Any) -> Any:
    """The member of a union of dataclasses that the data's `kind` names; else its first dataclass."""
    members = [unwrap(option)[0] for option in get_args(union)]
    classes = [option for option in members if dataclasses.is_dataclass(option)]
    wanted = data.get("kind") if isinstance(data, Mapping) else None
    for option in classes:
        if wanted is not None and wanted in get_args(annotations(option).get("kind")):
            return option
    return classes[0] if classes else None
