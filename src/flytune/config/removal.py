"""Removing what a file or an edit no longer wants: TOML has no null, so that the text "none" takes its place."""

from collections.abc import Mapping
from typing import Any

from flytune.config.fields import is_named, is_optional, step_into

NONE = "none"


def without_none(kind: Any, data: Mapping[str, Any]) -> dict[str, Any]:
    """The tables without each named entry and each optional field that is "none".

    A whole table of named entries that is "none" becomes empty. Elsewhere the text is left for the check of values.

    Args:
        kind: the dataclass, or annotation, that the tables are read as.
        data: the tables.
    """
    result: dict[str, Any] = {}
    for key, value in data.items():
        inner = step_into(kind, key, data)
        if value == NONE and isinstance(value, str):
            if is_named(kind) or is_optional(inner):
                continue
            result[key] = {} if is_named(inner) else value
        else:
            result[key] = without_none(inner, value) if inner is not None and isinstance(value, Mapping) else value
    return result
