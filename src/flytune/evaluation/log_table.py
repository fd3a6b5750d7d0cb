"""A table of numbers in a text file, as programs that log flights write them: its header, and the columns asked for.

The delimiter, the decimal comma, the encoding and the place of the header are found; what cannot be read is one line.
"""

import csv
import dataclasses
import re
from array import array
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from flytune.errors import BadInput

DELIMITERS = {",": "comma", ";": "semicolon", "\t": "tab", "|": "bar", " ": "space"}
EMPTY = {"", "nan", "null", "none", "n/a", "na", "-", "--"}
LARGEST = 2_000_000_000  # bytes
DECIMAL_COMMA = re.compile(r"[+-]?\d*,\d+([eE][+-]?\d+)?")


@dataclasses.dataclass(frozen=True)
class LogTable:
    """A log before its numbers are read."""

    path: Path
    encoding: str
    delimiter: str
    header: tuple[str, ...]  # `col1`, `col2`, ... where the file has none
    units: tuple[str, ...]  # of a second row of the header; empty texts without one
    first: int  # lines before the first row of numbers

    def read(self, columns: Sequence[int]) -> np.ndarray:
        """The numbers [rows, columns] of some columns; NaN where a cell is empty.

        Raises:
            BadInput: a cell is no number, a row is too short, or there is no row.
        """
        numbers, needed, short = array("d"), max(columns, default=0) + 1, 0
        for number, cells in self._rows():
            if short:
                raise BadInput(
                    f"{self.path}: row {short} has fewer cells than the header, which has {len(self.header)}. "
                    "Remove this row."
                )
            if len(cells) < needed:
                short = number  # the last row of a log that was cut off, unless another one follows
                continue
            if len(cells) > len(self.header) and any(cell.strip() for cell in cells[len(self.header) :]):
                raise BadInput(
                    f"{self.path}: row {number} has {len(cells)} cells, and the header has {len(self.header)}. Where "
                    "the decimals have commas, put semicolons between the columns."
                )
            for column in columns:
                numbers.append(self._number(cells[column], number, column))
        if not numbers:
            raise BadInput(f"{self.path}: has no row of numbers. Allowed: a header, and rows of numbers below it.")
        return np.frombuffer(numbers, dtype=np.float64).reshape(-1, len(columns)).copy()

    def _rows(self) -> Iterator[tuple[int, list[str]]]:
        for number, line in _lines(self.path, self.encoding):
            if number > self.first and line.strip() and line.lstrip()[0] not in "#%":
                yield number, _split(line, self.delimiter)

    def _number(self, cell: str, row: int, column: int) -> float:
        text = cell.strip()
        if text.lower() in EMPTY:
            return np.nan
        if self.delimiter != "," and DECIMAL_COMMA.fullmatch(text):
            text = text.replace(",", ".")
        try:
            return float(text)
        except ValueError:
            raise BadInput(
                f"{self.path}: row {row}, column {self.header[column]}: {text[:40]!r} is no number. Allowed: numbers, "
                "and empty cells where nothing was logged."
            ) from None


def open_log(path: Path) -> LogTable:
    """A text file of numbers, with its header.

    Raises:
        BadInput: it cannot be read, is empty, is no text, or has a single column.
    """
    encoding = _encoding(path)
    comment, delimiter, header = "", "", None
    for number, line in _lines(path, encoding):
        text = line.strip()
        if text.lower().startswith("sep=") and len(text) == 5:  # how spreadsheets announce the delimiter
            delimiter = text[4]
        elif not text:
            continue
        elif header is not None:  # the row below the header: units, or numbers
            units = tuple(cell.strip().strip("[]()") for cell in _split(line, delimiter))
            numbers = any(unit and _is_number(unit, delimiter) for unit in units)
            if numbers or max(map(len, units)) > 8 or len(units) != len(header):
                return LogTable(path, encoding, delimiter, header, ("",) * len(header), number - 1)
            return LogTable(path, encoding, delimiter, header, units, number)
        elif text[0] in "#%":
            comment = text.lstrip("#% ")
        else:
            delimiter = delimiter or _delimiter(text)
            cells = _split(line, delimiter)
            if len(cells) < 2:
                raise BadInput(
                    f"{path}: has one column, {text[:60]!r}. Allowed: columns between commas, semicolons, tabs, "
                    "bars or spaces."
                )
            if not all(_is_number(cell, delimiter) for cell in cells):
                header = tuple(cell.strip().strip("\"'") for cell in cells)
                continue
            named = [cell.strip() for cell in _split(comment, _delimiter(comment))] if comment else []
            names = named if len(named) == len(cells) else [f"col{index}" for index in range(1, len(cells) + 1)]
            return LogTable(path, encoding, delimiter, tuple(names), ("",) * len(names), number - 1)
    if header is not None:
        raise BadInput(f"{path}: has a header and no row of numbers. Allowed: a header, and rows of numbers below it.")
    raise BadInput(f"{path}: is empty. Allowed: a header, and rows of numbers below it.")


def _encoding(path: Path) -> str:
    """The encoding of a text file.

    Raises:
        BadInput: it cannot be read, is too large, or is no text.
    """
    try:
        with path.open("rb") as file:
            head = file.read(1 << 16)
            size = file.seek(0, 2)
    except OSError as error:
        raise BadInput(f"{path}: cannot be read ({error.strerror}). Give a .csv log or an .npz file.") from None
    if size > LARGEST:
        raise BadInput(f"{path}: has {size / 1e9:.1f} GB. Allowed: {LARGEST / 1e9:g} GB. Cut it to the flight.")
    if head.startswith((b"\xff\xfe", b"\xfe\xff")):
        return "utf-16"
    if b"\x00" in head:
        raise BadInput(
            f"{path}: is no text. Allowed: a .csv log, or an .npz file. Convert it first, for instance with ulog2csv."
        )
    try:
        head[: max(len(head) - 4, 0) or None].decode("utf-8-sig")  # its end may cut a character in two
    except UnicodeDecodeError:
        return "latin-1"
    return "utf-8-sig"


def _lines(path: Path, encoding: str) -> Iterator[tuple[int, str]]:
    try:
        with path.open(encoding=encoding, errors="replace", newline=None) as file:
            yield from enumerate(file, start=1)
    except (OSError, UnicodeError) as error:
        raise BadInput(f"{path}: cannot be read ({error}). Give a .csv log or an .npz file.") from None


def _delimiter(text: str) -> str:
    """What separates the cells of a line: the most frequent delimiter; a comma may also be that of decimals."""
    counts = {each: text.count(each) for each in DELIMITERS if each != " "}
    if counts[";"] or counts["\t"]:
        counts[","] = 0
    most = max(counts, key=counts.__getitem__)
    return most if counts[most] else " "


def _split(line: str, delimiter: str) -> list[str]:
    if delimiter == " ":
        return line.split()
    try:
        return next(csv.reader([line.rstrip("\r\n")], delimiter=delimiter))
    except (csv.Error, StopIteration):
        return line.rstrip("\r\n").split(delimiter)


def _is_number(cell: str, delimiter: str) -> bool:
    text = cell.strip()
    if text.lower() in EMPTY:
        return True
    try:
        float(text.replace(",", ".") if delimiter != "," and DECIMAL_COMMA.fullmatch(text) else text)
    except ValueError:
        return False
    return True
