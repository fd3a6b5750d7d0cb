"""Type, unit and range of a dataclass's field from its annotation, `Annotated[Real, Ge(0), Unit("m/s")]`, in words."""

import dataclasses
import difflib
import types
from collections.abc import Iterable, Mapping
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

import annotated_types
from pydantic import AllowInfNan, Strict

from flytune.config.formula import Formula

Real = Annotated[float, Strict(), AllowInfNan(False)]
Whole = Annotated[int, Strict()]
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
    """The option spelled most like `name`, or None where nothing is near."""
    found = difflib.get_close_matches(name, list(options), n=1, cutoff=0.6)
    return found[0] if found else None


def unit_text(annotation: Any, before: str = "") -> str:
    """The unit of an annotation with `before` in front of it; empty where it has none."""
    base, details = unwrap(annotation)
    if get_origin(base) is tuple:
        return unit_text(get_args(base)[0], before)
    for detail in details:
        if isinstance(detail, annotated_types.Unit) and detail.unit != "1":
            return before + detail.unit
    return ""


def unwrap(annotation: Any) -> tuple[Any, list[Any]]:
    """A type without its Annotated layers, and the contents of those layers."""
    details: list[Any] = []
    while get_origin(annotation) is Annotated:
        annotation, *more = get_args(annotation)
        details += more
    return annotation, details


def annotations(kind: Any) -> dict[str, Any]:
    """The annotation of each field of a dataclass, with `Annotated`."""
    return get_type_hints(kind, include_extras=True)


def step_into(annotation: Any, name: Any, data: Any) -> Any:
    """The annotation one step further down a path, or None where there is no such field."""
    base, _ = unwrap(annotation)
    if is_union(base):
        base = variant_of(base, data)
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
