"""Reading: TOML to nested tables to dataclasses, with one line for what cannot be read.

`plain` and `write` of config/writing.py do the reverse, and belong to the same interface.
"""

import dataclasses
import functools
import re
import tomllib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, TypeVar, get_args, get_origin

from pydantic import TypeAdapter, ValidationError

from flytune.config.fields import (
    Derived,
    Real,
    Vector,
    Whole,
    allowed,
    annotations,
    is_optional,
    is_union,
    list_like,
    nearest,
    reason,
    slip,
    step_into,
    unit_of,
    unit_text,
    unwrap,
    variant_of,
)
from flytune.config.nested import LABELS, leaves, look_up
from flytune.config.writing import plain, source_of, write
from flytune.errors import BadInput

__all__ = [
    "Derived", "Real", "Vector", "Whole", "allowed", "load", "nearest", "parse", "parse_assignment", "plain", "read",
    "source_of", "unit_of", "write",
]  # fmt: skip

T = TypeVar("T")


def load(path: Path, where: str = "", remedy: str = "Give a TOML file or a preset's name.") -> dict[str, Any]:
    """The content of a TOML file.

    Args:
        path: the file.
        where: the beginning of a message.
        remedy: the end of the message about a file that cannot be read.

    Raises:
        BadInput: the file is missing, unreadable or not TOML.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        raise BadInput(f"{where}{path}: cannot be read ({error.strerror}). {remedy}") from None
    except UnicodeDecodeError:
        raise BadInput(f"{where}{path}: is not text. Give a TOML file in UTF-8.") from None
    return parse(text, f"{where}{path}")


def parse(text: str, where: str) -> dict[str, Any]:
    """The tables of a TOML text.

    Raises:
        BadInput: it is not TOML.
    """
    try:
        return tomllib.loads(text)
    except ValueError as error:  # also of a number with thousands of digits
        raise BadInput(f"{where}: is not valid TOML: {error}.") from None


def read(kind: type[T], data: Mapping[str, Any], where: str = "", together: bool = True) -> T:
    """A dataclass made with `pytree` from nested tables, every value checked.

    Args:
        kind: the dataclass.
        data: its tables.
        where: the beginning of a message, for instance the file.
        together: whether the values of the outermost table are checked together as well (its `problem`).

    Raises:
        BadInput: an unknown or missing key, a wrong type, a value out of range; one line that names `where`, for
            instance the file, and the field path.
    """
    prefix = f"{where}: " if where else ""
    try:
        result = _adapter(kind).validate_python(data)
    except ValidationError as error:
        raise BadInput(prefix + _explain(kind, data, error)) from None
    for path, node in _nodes(result):
        if (path or together) and (problem := getattr(node, "problem", lambda: None)()):
            raise BadInput(prefix + ".".join((*path, problem)))
    return result


@functools.cache
def _adapter(kind: Any) -> Any:
    """What checks the values of a dataclass; to build it takes longer than to use it."""
    return TypeAdapter(kind)


def parse_assignment(text: str) -> tuple[str, Any]:
    """Path and value of `path=value`; the value is read as TOML, and as a bare string where it is not TOML.

    Raises:
        BadInput: there is no `=`, or nothing before it.
    """
    path, equals, value = text.partition("=")
    if not equals or not path.strip():
        raise BadInput(f"{text}: not an assignment. Write path=value, for instance reward.velocity.weight=0.08.")
    try:
        return path.strip(), tomllib.loads(f"value = {value}")["value"]
    except ValueError:
        return path.strip(), value.strip()


def _nodes(node: Any, path: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Any]]:
    if dataclasses.is_dataclass(node):
        yield path, node
        for field in dataclasses.fields(node):
            yield from _nodes(getattr(node, field.name), (*path, field.name))
    elif isinstance(node, dict):
        for key, item in node.items():
            yield from _nodes(item, (*path, key))


def _explain(kind: Any, data: Any, error: ValidationError) -> str:
    """One line for the first thing that is wrong, unknown keys before what they may have been meant for."""
    problem = min(error.errors(), key=lambda problem: problem["type"] != "unexpected_keyword_argument")
    place: tuple[Any, ...] = problem["loc"]
    no_list = problem["type"] in ("tuple_type", "too_long")
    if problem["type"] == "missing" and isinstance(place[-1], int):  # a list that is too short
        place, no_list = place[:-1], True
    node: Any = data
    annotation, path = kind, []
    for index, name in enumerate(place):
        final = index == len(place) - 1
        if final and problem["type"] == "unexpected_keyword_argument":
            return _unknown_key(annotation, node, path, str(name), data)
        is_key = isinstance(node, Mapping) and name in node
        is_index = isinstance(node, list | tuple) and isinstance(name, int) and name < len(node)
        if not (is_key or is_index or (final and problem["type"] == "missing")):
            continue  # the tag of a union, which is no part of the path
        annotation = step_into(annotation, name, node)
        node = node[name] if is_key or is_index else None
        path.append(str(name))
    where = ".".join(path)
    if problem["type"].startswith("union_tag"):
        known = _kinds(annotation)
        named = node.get("kind") if isinstance(node, Mapping) else None
        if isinstance(node, Mapping) and "kind" not in node:
            others = look_up(data, ".".join(path[:-1])) or {}
            hint = nearest(path[-1], [each for each in others if each != path[-1]])
            key = list(node) if len(node) == 1 else []
            meant = f" Did you mean {'.'.join([*path[:-1], hint, *key])}?" if hint else ""
            return f"{where}: is new here and has no kind.{meant} A new one needs a kind: {', '.join(known)}."
        hint = nearest(str(named), known)
        return f"{where}.kind: {named!r} is none of: {', '.join(known)}." + (f" Did you mean {hint}?" if hint else "")
    is_missing = problem["type"] == "missing" and not no_list
    found = "missing" if is_missing else f"{_shown(node)} is not allowed"
    if problem["type"] == "value_error" and "ctx" in problem:  # of a check of our own, which says why
        return f"{where}: {found}: {problem['ctx']['error']}."
    accepts = functools.partial(_accepts, annotation)
    hint = "" if is_missing else slip(annotation, node, accepts)
    if no_list and (example := list_like(annotation, node, accepts)):
        begin = "" if any(each.isdigit() for each in path) else f"{where}="
        hint = f" For instance {begin}{example}.".replace(", ", ",")
    elif others := _joined(data, where):
        hint += f" Did you mean {' or '.join(others)}?"
    if not is_missing and is_optional(annotation):
        hint += ' "none" removes it.'
    return f"{where}: {found}. Allowed: {allowed(annotation)}{unit_text(annotation, ' ')}{reason(annotation)}.{hint}"


def _accepts(annotation: Any, value: Any) -> bool:
    """Whether a field of this type accepts a value."""
    try:
        _adapter(annotation).validate_python(value)
    except ValidationError:
        return False
    return True


def _unknown_key(annotation: Any, node: Any, path: list[str], name: str, data: Any) -> str:
    base, _ = unwrap(annotation)
    if is_union(base):
        base = variant_of(base, node)
    fields = annotations(base) if dataclasses.is_dataclass(base) else {}
    where = ".".join([*path, name])
    if others := _joined(data, where):
        return f"{where}: no such field. Did you mean {' or '.join(others)}?"
    hint = nearest(name, list(fields))
    if hint is None and (others := _elsewhere(data, where, name, node[name])):
        return f"{where}: no such field. Did you mean {' or '.join(others)}?"
    if hint is None:
        return f"{where}: no such field. Fields here: {', '.join(fields)}."
    now = f"now {_shown(node[hint])}, " if hint in node and not isinstance(node[hint], Mapping) else ""
    return f"{where}: no such field. Did you mean {'.'.join([*path, hint])} ({now}allowed: {allowed(fields[hint])})?"


def _elsewhere(data: Any, where: str, name: str, value: Any) -> list[str]:
    """Up to three paths of existing fields that end as a wrong path does, for instance vehicle.mass for mass."""
    wanted = [f".{name}.{path}" for path, _ in leaves(value)] if isinstance(value, Mapping) else [f".{name}"]
    there = [".".join(path) for path in _paths(data) if not f"{'.'.join(path)}.".startswith(f"{where}.")]
    return [path for path in there if path.endswith(tuple(wanted))][:3]


def _joined(data: Any, where: str) -> list[str]:
    """Up to three paths of existing fields that are a wrong one with other separators: target.yaw for target_yaw."""

    def bare(*keys: str) -> str:
        return re.sub(r"[^0-9a-z]+", "_", "_".join(keys).lower())

    ends = ((path, {bare(*path[depth:]) for depth in range(len(path) - 1)}) for path in _paths(data))
    return [".".join(path) for path, joined in ends if ".".join(path) != where and bare(where) in joined][:3]


def _paths(data: Any, path: tuple[str, ...] = ()) -> Iterator[tuple[str, ...]]:
    """The paths of all tables and values, those of labels left out."""
    for key, value in data.items() if isinstance(data, Mapping) else ():
        if key not in LABELS:
            yield (*path, key)
            yield from _paths(value, (*path, key))


def _shown(value: Any) -> str:
    text = "a table" if isinstance(value, Mapping) else repr(value)
    return text if len(text) <= 60 else text[:57] + "..."


def _kinds(annotation: Any) -> list[str]:
    base, _ = unwrap(annotation)
    if get_origin(base) is dict:
        return _kinds(get_args(base)[1])
    options = get_args(base) if is_union(base) else (base,)
    return [get_args(annotations(unwrap(option)[0])["kind"])[0] for option in options]
