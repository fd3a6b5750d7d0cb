"""Documents: TOML to dataclasses and back, with one clear line for whatever cannot be read.

The dataclasses say everything there is to know about a field: its type, unit and range stand in its annotation
(`Annotated[Real, Ge(0), Unit("m/s")]`), so the reader, the writer and the error messages need no second list.
"""

import dataclasses
import difflib
import tomllib
import types
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

import annotated_types
import tomlkit
from pydantic import AllowInfNan, Strict, TypeAdapter, ValidationError

from flytune.errors import BadInput

T = TypeVar("T")

Real = Annotated[float, Strict(), AllowInfNan(False)]
Whole = Annotated[int, Strict()]
Vector = tuple[Real, Real, Real]

_LOWER = {annotated_types.Ge: "ge", annotated_types.Gt: "gt"}
_UPPER = {annotated_types.Le: "le", annotated_types.Lt: "lt"}


def load(path: Path) -> dict[str, Any]:
    """The content of a TOML file.

    Raises:
        BadInput: the file is missing, unreadable or not TOML.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        raise BadInput(f"{path}: cannot be read ({error.strerror}). Give a TOML file or a preset's name.") from None
    except UnicodeDecodeError:
        raise BadInput(f"{path}: is not text. Give a TOML file in UTF-8.") from None
    return parse(text, str(path))


def parse(text: str, where: str) -> dict[str, Any]:
    """The tables of a TOML text.

    Raises:
        BadInput: it is not TOML.
    """
    try:
        return tomllib.loads(text)
    except ValueError as error:  # also of a number with thousands of digits
        raise BadInput(f"{where}: is not valid TOML: {error}.") from None


def read(kind: type[T], data: Mapping[str, Any], where: str = "") -> T:
    """A `kind` made from plain data, every value checked.

    Args:
        kind: a dataclass made with `pytree`.
        data: nested tables as TOML gives them.
        where: what to name in front of an error, for instance the file.

    Raises:
        BadInput: an unknown or missing key, a wrong type, a value out of range; one line that names the field path.
    """
    try:
        result = TypeAdapter(kind).validate_python(data)
    except ValidationError as error:
        raise BadInput(_prefix(where) + _explain(kind, data, error)) from None
    for path, node in _nodes(result):
        if problem := getattr(node, "problem", lambda: None)():
            raise BadInput(f"{_prefix(where)}{'.'.join((*path, problem))}")
    return result


def plain(node: Any) -> dict[str, Any]:
    """The nested tables a dataclass is written as, the inverse of `read`; empty optional fields are left out."""
    result = {}
    for field in dataclasses.fields(node):
        value = getattr(node, field.name)
        if value is None or (field.metadata.get("label") and value in ({}, "")):
            continue
        result[field.name] = _plain_value(value)
    return result


def overlay(below: Mapping[str, Any], above: Mapping[str, Any]) -> dict[str, Any]:
    """Nested tables with those of `above` laid over them.

    A table adds to a table, and replaces one of another `kind`; any other value replaces.
    """
    result = dict(below)
    for key, value in above.items():
        there = result.get(key)
        result[key] = value
        if isinstance(value, Mapping) and isinstance(there, Mapping):
            kind = there.get("kind")
            if value.get("kind", kind) == kind:
                result[key] = overlay(there, value)
    return result


def edit(data: Mapping[str, Any], path: str, value: Any) -> dict[str, Any]:
    """The same tables with the field at a dotted path replaced.

    Raises:
        BadInput: the path runs through something that is not a table.
    """
    result = _plain_value(data)
    node, names = result, path.split(".")
    for depth, name in enumerate(names[:-1]):
        node = node.setdefault(name, {})
        if not isinstance(node, dict):
            raise BadInput(f"{path}: {'.'.join(names[: depth + 1])} is a value, not a table.")
    node[names[-1]] = value
    return result


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


def write(node: Any, sources: Mapping[str, str] | None = None, heading: str = "") -> str:
    """The TOML text of a dataclass: exact values, each with its unit, allowed range and source as a comment.

    Args:
        node: a dataclass made with `pytree`.
        sources: field path, or the start of one -> where its value comes from.
        heading: lines to stand on top, as comments.
    """
    document = tomlkit.document()
    for line in heading.splitlines():
        document.add(tomlkit.comment(line))
    _fill(document, node, (), sources or {})
    return tomlkit.dumps(document)


def source_of(path: str, sources: Mapping[str, str]) -> str:
    """The source of a field: its own entry, or that of the nearest table above it; empty where there is none."""
    parts = path.split(".")
    for length in range(len(parts), 0, -1):
        if found := sources.get(".".join(parts[:length])):
            return found
    return ""


def allowed(annotation: Any) -> str:
    """The values a field accepts, in words."""
    base, details = _unwrap(annotation)
    if get_origin(base) is Literal:
        return "one of " + ", ".join(map(str, get_args(base)))
    if get_origin(base) in (Union, types.UnionType):
        options = [option for option in get_args(base) if option is not type(None)]
        return " or ".join(dict.fromkeys(allowed(option) for option in options))
    if dataclasses.is_dataclass(base) or get_origin(base) is dict:
        return "a table"
    if get_origin(base) is tuple:
        items = [item for item in get_args(base) if item is not Ellipsis]
        length = f"{len(items)} values" if len(items) == len(get_args(base)) else "a list"
        return f"{length}, each {allowed(items[0])}"
    lower = [(getattr(d, _LOWER[type(d)]), type(d)) for d in details if type(d) in _LOWER]
    upper = [(getattr(d, _UPPER[type(d)]), type(d)) for d in details if type(d) in _UPPER]
    number = "a whole number" if base is int else ""
    if lower and upper:
        above = "above " if lower[0][1] is annotated_types.Gt else ""
        below = "below " if upper[0][1] is annotated_types.Lt else ""
        text = f"{above}{lower[0][0]} to {below}{upper[0][0]}"
    elif lower:
        text = f"above {lower[0][0]}" if lower[0][1] is annotated_types.Gt else f"{lower[0][0]} or more"
    elif upper:
        text = f"below {upper[0][0]}" if upper[0][1] is annotated_types.Lt else f"{upper[0][0]} or less"
    else:
        text = {float: "a finite number", int: "", str: "text", bool: "true or false"}.get(base, str(base))
    return ", ".join(part for part in (number, text) if part)


def unit_of(kind: Any, data: Mapping[str, Any], path: str) -> str:
    """The unit of the field at a dotted path of a dataclass's tables; empty where it has none, or there is no field."""
    annotation, node = kind, data
    for name in path.split("."):
        annotation = _step(annotation, name, node)
        node = node.get(name, {}) if isinstance(node, Mapping) else {}
    return "" if annotation is None else _unit(annotation, "")


def nearest(name: str, options: Iterator[str] | list[str]) -> str | None:
    """The option spelled most like `name`, or None where nothing is near."""
    found = difflib.get_close_matches(name, list(options), n=1, cutoff=0.6)
    return found[0] if found else None


def _prefix(where: str) -> str:
    return f"{where}: " if where else ""


def _plain_value(value: Any) -> Any:
    if dataclasses.is_dataclass(value):
        return plain(value)
    if isinstance(value, Mapping):
        return {key: _plain_value(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain_value(item) for item in value]
    return value


def _nodes(node: Any, path: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Any]]:
    if dataclasses.is_dataclass(node):
        yield path, node
        for field in dataclasses.fields(node):
            yield from _nodes(getattr(node, field.name), (*path, field.name))
    elif isinstance(node, dict):
        for key, item in node.items():
            yield from _nodes(item, (*path, key))


def _unwrap(annotation: Any) -> tuple[Any, list[Any]]:
    """A type without its Annotated layers, and everything those layers said."""
    details: list[Any] = []
    while get_origin(annotation) is Annotated:
        annotation, *more = get_args(annotation)
        details += more
    return annotation, details


def _field_annotations(kind: Any) -> dict[str, Any]:
    return get_type_hints(kind, include_extras=True)


def _step(annotation: Any, name: Any, data: Any) -> Any:
    """The annotation one step further down a path, or None where the path leaves what is known."""
    base, _ = _unwrap(annotation)
    if get_origin(base) in (Union, types.UnionType):
        base = _variant(base, data)
    if dataclasses.is_dataclass(base):
        return _field_annotations(base).get(name)
    if get_origin(base) is dict:
        return get_args(base)[1]
    if get_origin(base) is tuple:
        return get_args(base)[0]
    return None


def _variant(union: Any, data: Any) -> Any:
    """The member of a union of dataclasses that the data's `kind` names; else its first dataclass."""
    members = [_unwrap(option)[0] for option in get_args(union)]
    classes = [option for option in members if dataclasses.is_dataclass(option)]
    wanted = data.get("kind") if isinstance(data, Mapping) else None
    for option in classes:
        if wanted is not None and wanted in get_args(_field_annotations(option).get("kind")):
            return option
    return classes[0] if classes else None


def _item(node: Any, name: Any) -> Any:
    return node[name]


def _explain(kind: Any, data: Any, error: ValidationError) -> str:
    """One line for the first thing that is wrong, unknown keys before what they may have been meant for."""
    problems = sorted(error.errors(), key=lambda problem: problem["type"] != "unexpected_keyword_argument")
    problem = problems[0]
    annotation, node, path = kind, data, []
    last = problem["loc"][-1] if problem["loc"] else None
    for index, name in enumerate(problem["loc"]):
        final = index == len(problem["loc"]) - 1
        is_key = isinstance(node, Mapping) and name in node
        is_index = isinstance(node, list | tuple) and isinstance(name, int) and name < len(node)
        missing = final and problem["type"] in ("missing", "unexpected_keyword_argument")
        if not (is_key or is_index or missing):
            continue  # the tag of a union, which is no part of the path
        if final and problem["type"] == "unexpected_keyword_argument":
            return _unknown_key(annotation, node, path, str(name))
        annotation = _step(annotation, name, node)
        node = _item(node, name) if is_key or is_index else None
        path.append(str(name))
    where = ".".join(path)
    if problem["type"].startswith("union_tag"):
        known = _kinds(annotation)
        named = node.get("kind") if isinstance(node, Mapping) else None
        hint = nearest(str(named), known)
        return f"{where}.kind: {named!r} is none of: {', '.join(known)}." + (f" Did you mean {hint}?" if hint else "")
    if problem["type"] == "missing" and not isinstance(last, int):
        return f"{where}: missing. Allowed: {allowed(annotation)}{_unit(annotation, ' ')}."
    return f"{where}: {_shown(node)} is not allowed. Allowed: {allowed(annotation)}{_unit(annotation, ' ')}."


def _unknown_key(annotation: Any, node: Any, path: list[str], name: str) -> str:
    base, _ = _unwrap(annotation)
    if get_origin(base) in (Union, types.UnionType):
        base = _variant(base, node)
    fields = _field_annotations(base) if dataclasses.is_dataclass(base) else {}
    where = ".".join([*path, name])
    hint = nearest(name, list(fields))
    if hint is None:
        return f"{where}: no such field. Fields here: {', '.join(fields)}."
    now = f"now {_shown(node[hint])}, " if hint in node and not isinstance(node[hint], Mapping) else ""
    return f"{where}: no such field. Did you mean {'.'.join([*path, hint])} ({now}allowed: {allowed(fields[hint])})?"


def _kinds(annotation: Any) -> list[str]:
    base, _ = _unwrap(annotation)
    if get_origin(base) is dict:
        return _kinds(get_args(base)[1])
    options = get_args(base) if get_origin(base) in (Union, types.UnionType) else (base,)
    return [get_args(_field_annotations(_unwrap(option)[0])["kind"])[0] for option in options]


def _shown(value: Any) -> str:
    text = "a table" if isinstance(value, Mapping) else repr(value)
    return text if len(text) <= 60 else text[:57] + "..."


def _unit(annotation: Any, before: str) -> str:
    base, details = _unwrap(annotation)
    if get_origin(base) is tuple:
        return _unit(get_args(base)[0], before)
    for detail in details:
        if isinstance(detail, annotated_types.Unit) and detail.unit != "1":
            return before + detail.unit
    return ""


def _fill(table: Any, node: Any, path: tuple[str, ...], sources: Mapping[str, str]) -> None:
    hints = _field_annotations(type(node))
    later = []
    for name, value in plain(node).items():
        original = getattr(node, name)
        if isinstance(value, dict):
            later.append((name, original, value))
            continue
        item = tomlkit.item(value)
        notes = [_unit(hints[name], "") or ("1" if _is_number(value) else ""), allowed(hints[name])]
        notes.append(source_of(".".join((*path, name)), sources))
        if name not in ("kind", "name"):
            item.comment("; ".join(note for note in notes if note))
        table.add(name, item)
    for name, original, value in later:
        inner = tomlkit.table()
        if dataclasses.is_dataclass(original):
            _fill(inner, original, (*path, name), sources)
        elif all(isinstance(item, dict) for item in value.values()):
            inner = tomlkit.table(is_super_table=bool(value))
            for key, item in original.items():
                leaf = tomlkit.table()
                _fill(leaf, item, (*path, name, key), sources)
                inner.add(key, leaf)
        else:
            for key, item in value.items():
                inner.add(key, item)
        table.add(name, inner)


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float | list) and not isinstance(value, bool)
