"""The reference of the task file: unit, allowed values, default and meaning of every key, from the dataclasses."""

import ast
import dataclasses
import inspect
import io
import textwrap
import tokenize
import types
from collections.abc import Iterator
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

import annotated_types
from docutils import nodes
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective

from flytune.config.fields import allowed, reason
from flytune.config.formula import Formula


def comments(kind: type) -> dict[str, str]:
    """The comment that follows each field in the source of a dataclass."""
    source = textwrap.dedent(inspect.getsource(kind))
    lines = {
        token.start[0]: token.string.lstrip("# ")
        for token in tokenize.generate_tokens(io.StringIO(source).readline)
        if token.type == tokenize.COMMENT
    }
    fields = [node for node in ast.walk(ast.parse(source)) if isinstance(node, ast.AnnAssign)]
    return {
        node.target.id: " ".join(lines[line] for line in range(node.lineno, node.end_lineno + 1) if line in lines)
        for node in fields
        if isinstance(node.target, ast.Name)
    }


def plain(annotation: Any) -> tuple[Any, list[Any]]:
    """A type without its `Annotated` layers, and what those layers say."""
    details: list[Any] = []
    while get_origin(annotation) is Annotated:
        annotation, *more = get_args(annotation)
        details += more
    return annotation, details


def unit(annotation: Any) -> str:
    """The unit of a field, or an empty text."""
    base, details = plain(annotation)
    if get_origin(base) is tuple:
        return unit(get_args(base)[0])
    if get_origin(base) in (Union, types.UnionType) and not details:
        return unit(get_args(base)[0])
    return next((detail.unit for detail in details if isinstance(detail, annotated_types.Unit)), "")


def variants(annotation: Any) -> list[type]:
    """The dataclasses a table may be: one, or one for each `kind`."""
    base, _ = plain(annotation)
    options = get_args(base) if get_origin(base) in (Union, types.UnionType) else (base,)
    return [option for option in (plain(each)[0] for each in options) if dataclasses.is_dataclass(option)]


def default(field: dataclasses.Field) -> str:
    """The value of a key that is left out."""
    if field.default is not dataclasses.MISSING:
        value = field.default
    elif field.default_factory is not dataclasses.MISSING:
        value = field.default_factory()
    else:
        return "required"
    if value is None:
        return "none"
    if isinstance(value, bool):
        return f"`{str(value).lower()}`"
    return f"`{list(value) if isinstance(value, tuple) else value!r}`".replace("'", '"')


def cell(text: str) -> str:
    """A text that cannot end a cell of a table."""
    return text.replace("|", "\\|").replace("*", "\\*")


def rows(kind: type) -> Iterator[str]:
    """A row of the table for each key of a dataclass that holds no table of its own."""
    hints = get_type_hints(kind, include_extras=True)
    notes: dict[str, str] = {}
    for each in reversed(kind.__mro__):  # a field may come from a class above
        notes |= comments(each) if dataclasses.is_dataclass(each) else {}
    for field in dataclasses.fields(kind):
        if field.metadata.get("derived"):
            continue
        annotation = hints[field.name]
        base, _ = plain(annotation)
        if get_origin(base) is dict and plain(get_args(base)[1])[0] is Formula:
            yield f"| `[{field.name}]` | | a table of formulas | none | {cell(notes[field.name])} |"
        if variants(annotation) or get_origin(base) is dict:
            continue
        if field.name == "kind":
            values = f"`{get_args(base)[0]}`" if get_origin(base) is Literal else ""
            given = '`"point"`' if values == "`point`" else "required"
            yield f"| `kind` | | {values} | {given} | names the class |"
            continue
        cells = (
            cell(unit(annotation)),
            cell(allowed(annotation) + reason(annotation)),
            default(field),
            cell(notes[field.name]),
        )
        yield f"| `{field.name}` | {' | '.join(cells)} |"


def tables(kind: type, path: str, level: int) -> Iterator[str]:
    """The Markdown of a dataclass: what it is, its keys, and the tables below it."""
    yield "#" * level + f" {path}"
    yield ""
    yield from (line.replace("*", "\\*") for line in inspect.cleandoc(kind.__doc__ or "").splitlines())
    yield ""
    found = list(rows(kind))
    if found:
        yield "| key | unit | allowed | default | meaning |"
        yield "|---|---|---|---|---|"
        yield from found
        yield ""
    hints = get_type_hints(kind, include_extras=True)
    for field in dataclasses.fields(kind):
        base, _ = plain(hints[field.name])
        inside = path.strip("`[]")
        name = field.name if path == "Task" else f"{inside}.{field.name}"
        if get_origin(base) is dict:
            for variant in variants(get_args(base)[1]):
                hint = get_type_hints(variant, include_extras=True).get("kind")
                kinds = f', kind `"{get_args(plain(hint)[0])[0]}"`' if hint else ""
                yield from tables(variant, f"`[{name}.NAME]`{kinds}", level + 1)
        else:
            found = variants(hints[field.name])
            for variant in found:
                hint = get_type_hints(variant, include_extras=True).get("kind")
                kinds = f', kind `"{get_args(plain(hint)[0])[0]}"`' if hint and len(found) > 1 else ""
                yield from tables(variant, f"`[{name}]`{kinds}", level + 1)


class TaskFile(SphinxDirective):
    """A section for each table of a task file."""

    def run(self) -> list[nodes.Node]:
        """The tables of `flytune.Task`."""
        import flytune

        text = "\n".join(tables(flytune.Task, "Task", 2))
        return self.parse_text_to_nodes(text, allow_section_headings=True)


def setup(app: Sphinx) -> dict[str, bool]:
    """Registers the directive `task-file`."""
    app.add_directive("task-file", TaskFile)
    return {"parallel_read_safe": True}
