"""One model of a table, written as text for a terminal, as HTML for a page and as Markdown.

A simple table is built from titles and texts; each column is as wide as its longest text:

    Table.plain(("rule", "when"), [("H1", "too slow"), ("H2", "overshoots")])

A table of numbers says how each column is computed from a record:

    Table.of([Column("settling [s]", lambda judged: judged["settling_time"]["median"], decimals=2)], judgements)

`str(table)` is the text; a Jinja template writes `{{ table }}` and gets the escaped HTML.
"""

import dataclasses
import itertools
import math
from collections.abc import Callable, Iterable, Sequence
from html import escape
from typing import Any, Literal

NULL = "-"  # stands for a number that does not exist or is infinite


@dataclasses.dataclass(frozen=True, kw_only=True)
class Cell:
    """A cell with more than a text: on a page it may have another text, a colour, or a coloured number."""

    text: str  # a line break in it starts a new line on a page
    page: str = ""  # what a page writes instead, where the terminal's text is shortened
    tone: str = ""  # CSS class of the text: "good", "bad" or "strong"; Markdown writes it in bold
    badge: int | None = None  # number of a controller, from 1, in its colour before the text; on pages only


Value = str | int | float | None | Cell


@dataclasses.dataclass(frozen=True)
class Column:
    """The heading of a column, how its cells are computed and how they are written.

    Args:
        title: the heading; with a `group` the second line of it.
        value: the cell of a record; columns of `Table.plain` have none.
        group: heading above all neighbouring columns that have the same one. Spaces at its ends, or at the ends of a
            title, shift it in a terminal only.
        align: "right" for numbers, "left" for words, which may break into lines on a page.
        decimals: of the numbers in it; None for whole numbers and texts.
        scale: factor of the numbers, from SI to the unit that the heading names.
        width: characters in a terminal, at least; without it as many as the longest text, and two spaces before them.
    """

    title: str = ""
    value: Callable[[Any], Value] | None = None
    _: dataclasses.KW_ONLY
    group: str = ""
    align: Literal["left", "right"] = "right"
    decimals: int | None = None
    scale: float = 1.0
    width: int | None = None

    def write(self, value: Value) -> Cell:
        """The cell of a value: numbers are scaled and rounded."""
        if isinstance(value, Cell):
            return value
        if isinstance(value, str):
            return Cell(text=value)
        if isinstance(value, int) and self.decimals is None:
            return Cell(text=str(value))
        return Cell(text=number(value, self.decimals or 0, self.scale))


@dataclasses.dataclass(frozen=True, kw_only=True)
class Table:
    """Columns and rows, ready to be written in any format; the first column names the rows."""

    columns: tuple[Column, ...]
    rows: tuple[tuple[Cell, ...], ...]
    underlined: bool = False  # a line under the headings in a terminal
    style: str = ""  # CSS classes on a page: "dense" for many columns, "narrow" for few

    @classmethod
    def of(cls, columns: Sequence[Column], records: Iterable[Any], **options: Any) -> "Table":
        """A table with a row per record, each cell computed by its column; options are the fields above."""
        cells = tuple(tuple(column.write(column.value(one)) for column in columns if column.value) for one in records)
        return cls(columns=tuple(columns), rows=cells, **options)

    @classmethod
    def plain(cls, titles: Sequence[str | Column], rows: Iterable[Sequence[Value]], **options: Any) -> "Table":
        """A table of given rows; a title stands for a left-aligned column."""
        columns = tuple(title if isinstance(title, Column) else Column(title, align="left") for title in titles)
        cells = tuple(tuple(column.write(value) for column, value in zip(columns, row, strict=True)) for row in rows)
        return cls(columns=columns, rows=cells, **options)

    @property
    def groups(self) -> list[tuple[str, list[Column]]]:
        """Neighbouring columns that share a group, under its heading; "" for a column without one."""
        alone = ((column.group or index, column) for index, column in enumerate(self.columns))
        found = itertools.groupby(alone, key=lambda pair: pair[0])
        return [(key if isinstance(key, str) else "", [column for _, column in pairs]) for key, pairs in found]

    def text(self) -> str:
        """The table for a terminal, in lines of plain text."""
        widths = [
            max([column.width or 0, len(column.title), *(len(row[index].text) for row in self.rows)])
            for index, column in enumerate(self.columns)
        ]
        gaps = ["  " if index and column.width is None else "" for index, column in enumerate(self.columns)]

        def line(texts: Iterable[str]) -> str:
            cells = zip(gaps, self.columns, widths, texts, strict=True)
            return "".join(gap + _pad(text, width, column.align) for gap, column, width, text in cells).rstrip()

        lines = [line(column.title for column in self.columns)]
        if any(column.group for column in self.columns):
            spans = iter(len(gap) + width for gap, width in zip(gaps, widths, strict=True))
            groups = [(group, sum(itertools.islice(spans, len(columns)))) for group, columns in self.groups]
            lines = ["".join(_pad(group, span, "right") for group, span in groups).rstrip(), *lines]
        if self.underlined:
            lines.append("-" * max(map(len, lines)))
        return "\n".join([*lines, *(line(cell.text for cell in row) for row in self.rows)])

    __str__ = text

    def html(self) -> str:
        """The table for a page, in a box that scrolls sideways where the table is wider; every text is escaped."""
        grouped = any(column.group for column in self.columns)
        upper, lower = [], []
        for group, columns in self.groups:
            span = f' colspan="{len(columns)}"'
            if group and any(column.title for column in columns):
                upper.append(f"<th{span}>{escape(group.strip())}</th>")
                lower += [_heading(column.title, column) for column in columns]
            else:
                rows = f' rowspan="2"{span}' if grouped else ""
                upper.append(_heading(group.strip() or columns[0].title, columns[0], rows))
        head = "".join(f"<tr>{''.join(row)}</tr>" for row in (upper, lower) if row)
        body = []
        for first, *others in self.rows:
            cells = (f"<td{_class(c)}>{_html(cell)}</td>" for c, cell in zip(self.columns[1:], others, strict=True))
            body.append(f'<tr><th scope="row">{_html(first)}</th>{"".join(cells)}</tr>')
        return (
            f'<div class="wide"><table class="{self.style}"><thead>{head}</thead>'
            f"<tbody>{''.join(body)}</tbody></table></div>"
        )

    __html__ = html  # what an autoescaping template asks for

    def markdown(self) -> str:
        """The table in Markdown."""
        head = [f"{column.group.strip()} {column.title.strip()}" for column in self.columns]
        lines = ["---" if column.align == "left" else "--:" for column in self.columns]
        rows = [[f"**{cell.text}**" if cell.tone else cell.text for cell in row] for row in self.rows]
        texts = ([text.strip().replace("|", "/").replace("\n", ", ") for text in row] for row in (head, lines, *rows))
        return "\n".join(f"| {' | '.join(row)} |" for row in texts)


def number(value: float | None, decimals: int, scale: float = 1.0) -> str:
    """A number as text; '-' where there is none, or it is infinite."""
    return NULL if value is None or not math.isfinite(value) else f"{value * scale:.{decimals}f}"


def _pad(text: str, width: int, align: str) -> str:
    return text.rjust(width) if align == "right" else text.ljust(width)


def _class(column: Column) -> str:
    return ' class="words"' if column.align == "left" else ""


def _heading(text: str, column: Column, span: str = "") -> str:
    return f"<th{_class(column)}{span}>{escape(text.strip())}</th>"


def _html(cell: Cell) -> str:
    text = escape(cell.page or cell.text).replace("\n", "<br>")
    if cell.tone:
        text = f'<span class="{escape(cell.tone)}">{text}</span>'
    return text if cell.badge is None else f'<b class="badge c{(cell.badge - 1) % 10}">{cell.badge}</b>{text}'
