"""Writing: dataclasses to nested tables, and to TOML in which every number has its unit, range and source."""

import dataclasses
from collections.abc import Mapping
from typing import Any

import tomlkit

from flytune.config.fields import allowed, annotations, unit_text


def plain(node: Any) -> dict[str, Any]:
    """The nested tables a dataclass is written as, the inverse of `read`; empty optional fields are left out."""
    fields = (field for field in dataclasses.fields(node) if not field.metadata.get("derived"))
    values = ((field, getattr(node, field.name)) for field in fields)
    return {
        field.name: _plain_value(value)
        for field, value in values
        if value is not None and not (_is_optional(field) and (value in ({}, "") or value == field.default == ()))
    }


def write(node: Any, sources: Mapping[str, str] | None = None, heading: str = "") -> str:
    """The TOML text of a dataclass: exact values, each with its unit, allowed range and source as a comment.

    `sources` maps field paths, or the tables above them, to the source; the heading becomes comments at the top.
    """
    document = tomlkit.document()
    for line in heading.splitlines():
        document.add(tomlkit.comment(line))
    _fill(document, node, (), sources or {})
    return tomlkit.dumps(document)


def source_of(path: str, sources: Mapping[str, str]) -> str:
    """The source of a field: its own entry, or that of the nearest table above it; empty where there is none."""
    while path and not sources.get(path):
        path = path.rpartition(".")[0]
    return sources.get(path, "")


def _is_optional(field: dataclasses.Field[Any]) -> bool:
    return field.default is not dataclasses.MISSING or field.default_factory is not dataclasses.MISSING


def _plain_value(value: Any) -> Any:
    if dataclasses.is_dataclass(value):
        return plain(value)
    if isinstance(value, Mapping):
        return {key: _plain_value(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain_value(item) for item in value]
    return value


def _fill(table: Any, node: Any, path: tuple[str, ...], sources: Mapping[str, str]) -> None:
    hints = annotations(type(node))
    later = []
    for name, value in plain(node).items():
        original = getattr(node, name)
        if isinstance(value, dict):
            later.append((name, original, value))
            continue
        item = tomlkit.item(value)
        if name not in ("kind", "name"):
            is_number = isinstance(value, int | float | list) and not isinstance(value, bool)
            unit = unit_text(hints[name]) or ("1" if is_number else "")
            notes = (unit, allowed(hints[name]), source_of(".".join((*path, name)), sources))
            item.comment("; ".join(filter(None, notes)))
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
