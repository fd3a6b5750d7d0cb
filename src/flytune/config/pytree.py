"""Frozen dataclasses that are JAX pytrees: numbers are leaves, structure is static, labels are left out."""

import dataclasses
from collections.abc import Mapping
from typing import Any, TypeVar, dataclass_transform

import jax
from pydantic import ConfigDict

from flytune.config.formula import Formula

T = TypeVar("T")
jax.tree_util.register_static(Formula)


def static(**options: Any) -> Any:
    """A field that belongs to the structure: another value compiles another program."""
    return dataclasses.field(metadata={"static": True}, **options)


def label(**options: Any) -> Any:
    """A field for people (a name, a source): it needs a default, and compiled code sees that default."""
    return dataclasses.field(metadata={"label": True}, **options)


def derived() -> Any:
    """A field that the class computes from its other fields; it is a leaf, and stands in no file."""
    return dataclasses.field(default=None, compare=False, repr=False, metadata={"derived": True})


@dataclass_transform(
    frozen_default=True, kw_only_default=True, field_specifiers=(dataclasses.field, static, label, derived)
)
def pytree(cls: type[T]) -> type[T]:
    """The class as a frozen, keyword-only dataclass, registered as a JAX pytree.

    Read from a file (`document.read`), unknown keys are refused.
    """
    made: Any = dataclasses.dataclass(frozen=True, kw_only=True)(cls)
    made.__pydantic_config__ = ConfigDict(extra="forbid")
    fields = dataclasses.fields(made)
    structure = [field.name for field in fields if field.metadata.get("static")]
    labels = [field.name for field in fields if field.metadata.get("label")]
    numbers = [field.name for field in fields if field.name not in structure and field.name not in labels]
    # jax below 0.10 takes each entry of drop_fields for a collection of names: the last entry is for it
    dropped: Any = [*labels, tuple(labels)]
    return jax.tree_util.register_dataclass(made, data_fields=numbers, meta_fields=structure, drop_fields=dropped)


def with_field(node: Any, path: tuple[str, ...], value: Any) -> Any:
    """The dataclass or dict with the field at a path replaced.

    Raises:
        KeyError: there is no such field.
    """
    if not path:
        return value
    name, *rest = path
    if isinstance(node, Mapping):
        return {**node, name: with_field(node[name], tuple(rest), value)}
    if not dataclasses.is_dataclass(node) or name not in {field.name for field in dataclasses.fields(node)}:
        raise KeyError(name)
    return dataclasses.replace(node, **{name: with_field(getattr(node, name), tuple(rest), value)})  # pyright: ignore
