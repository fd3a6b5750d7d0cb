"""Nested tables: the one place where they are walked, looked up, edited, laid over each other and compared."""

from collections.abc import Collection, Iterator, Mapping
from typing import Any

from flytune.errors import BadInput

LABELS = ("name", "sources")  # for people: two tasks that differ in nothing else are the same task


def leaves(table: Mapping[str, Any], skip: Collection[str] = (), separator: str = ".") -> Iterator[tuple[str, Any]]:
    """Path and value of everything that is no table; keys in `skip` are left out at every depth."""
    for key, value in table.items():
        if key in skip:
            continue
        if isinstance(value, Mapping):
            yield from ((f"{key}{separator}{path}", leaf) for path, leaf in leaves(value, skip, separator))
        else:
            yield key, value


def look_up(table: Mapping[str, Any], path: str) -> Any:
    """The value or table at a dotted path; None where there is none."""
    node: Any = table
    for key in path.split("."):
        node = node.get(key) if isinstance(node, Mapping) else None
    return node


def edit(table: Mapping[str, Any], path: str, value: Any) -> dict[str, Any]:
    """The same tables with the value at a dotted path replaced; tables that are missing on the way are made.

    Raises:
        BadInput: the path runs through something that is not a table.
    """
    keys = path.split(".")
    result: dict[str, Any] = dict(table)
    node = result
    for depth, key in enumerate(keys[:-1], start=1):
        below = node.get(key, {})
        if not isinstance(below, Mapping):
            raise BadInput(f"{path}: {'.'.join(keys[:depth])} is a value, not a table.")
        node[key] = dict(below)
        node = node[key]
    node[keys[-1]] = value
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


def changes(before: Mapping[str, Any], after: Mapping[str, Any]) -> dict[str, Any]:
    """Path and new value of everything in which two nested tables differ, names and sources apart; None where gone."""
    one, other = (dict(leaves(table, skip=LABELS)) for table in (before, after))
    return {path: other.get(path) for path in sorted(one.keys() | other.keys()) if one.get(path) != other.get(path)}


def first_difference(first: Mapping[str, Any], second: Mapping[str, Any]) -> str | None:
    """The path of the first value in which two nested tables differ, names and sources apart; None where none does."""
    return next(iter(changes(first, second)), None)
