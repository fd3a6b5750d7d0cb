"""Waypoints: positions at given times, with steps or a smooth curve between them; also read from a CSV file."""

import csv
import math
from collections.abc import Mapping
from pathlib import Path as File
from typing import Annotated, Any, Literal

import jax.numpy as jnp
import numpy as np
from annotated_types import Ge, Le, Unit
from scipy.interpolate import CubicSpline

from flytune.config.document import Derived, Real
from flytune.config.pytree import derived, label, pytree, static
from flytune.errors import BadInput
from flytune.kernels.batched import LARGEST
from flytune.physics.components import Components
from flytune.task.paths import Metres
from flytune.task.reference import Path, Reference

MOST = 10_000  # waypoints; a task and a policy's file hold them all
SHORTEST_STEP = 0.5  # s; nothing settles sooner, since it has to stay in the band for so long
LARGEST_GAP = 10  # in a file, times the median time from row to row
LARGEST_YAW = 30  # rad, in a file; a larger one is probably in degrees
COLUMNS = ("t", "x", "y", "z", "yaw")


@pytree
class Waypoints(Path):
    """Positions at given times. After the last one the target stays there.

    With `interpolation` "steps" the target jumps to each position at its time, and each step is judged on its own. With
    "smooth" it moves along a cubic spline.

    A table with `kind = "csv"` and `file` reads them from a file with the columns t, x, y, z and, where wanted, yaw, in
    s, m and rad. The path of the file is relative to that of the task. A curve from a file is smooth with free ends,
    unless the table says otherwise.
    """

    kind: Literal["waypoints"] = static(default="waypoints")
    times: tuple[Annotated[Real, Ge(0), Le(3600), Unit("s")], ...] = label(default=())  # the first is 0
    positions: tuple[tuple[Metres, Metres, Metres], ...] = label(default=())  # one for each time
    yaws: tuple[Annotated[Real, Ge(-1000), Le(1000), Unit("rad")], ...] = label(default=())  # none: always `yaw`
    yaw: Annotated[Real, Ge(-2 * math.pi), Le(2 * math.pi), Unit("rad")] = label(
        default=0.0
    )  # with yaws: added to them
    interpolation: Literal["steps", "smooth"] = static(default="steps")
    ends: Literal["at_rest", "free"] = label(default="at_rest")  # of a smooth curve: where it begins and ends
    table: Derived = derived()  # [waypoints, 17]: time, and the cubic polynomial of x, y, z, yaw from there on

    def __post_init__(self) -> None:
        if self.times and self.problem() is None:
            object.__setattr__(self, "table", self._table())

    @property
    def position(self) -> Components:
        """The position at time 0, in m."""
        return tuple(self.table[0, 13:16])

    @property
    def first_yaw(self) -> Any:
        """The yaw at time 0, in rad."""
        return self.table[0, 16]

    def place(self, time: Any, xp: Any = jnp) -> Components:
        """The position in m at a time in s."""
        return self._at(time, xp)[:3]

    def heading(self, time: Any, xp: Any = jnp) -> Any:
        """The yaw in rad at a time in s."""
        return self._at(time, xp)[3]

    def reference(self, time: Any, gravity: Any) -> Reference:
        """The reference at a time in s; between steps it rests."""
        if self.interpolation == "steps":
            *place, yaw = self._at(jnp.asarray(time, float), jnp)
            return Reference(position=tuple(place), yaw=yaw)
        return super().reference(time, gravity)

    def problem(self) -> str | None:
        """What makes the waypoints impossible together, or None."""
        number, gaps = len(self.times), np.diff(self.times)
        least = 1 if self.interpolation == "steps" else 2
        if not least <= number <= MOST:
            return f"times: {number} waypoints are not allowed. Allowed: {least} to {MOST}."
        if self.times[0] != 0:
            return f"times: {self.times[0]:g} s is not allowed as the first time. Allowed: 0."
        if (gaps <= 0).any():
            where = int(np.argmax(gaps <= 0))
            before, after = self.times[where : where + 2]
            return f"times: {after:g} s does not come after {before:g} s. Allowed: rising times."
        for name in ("positions", "yaws"):
            given = len(getattr(self, name))
            if given != number and (given or name == "positions"):
                return f"{name}: {given} for {number} times is not allowed. Allowed: {number}, one for each time."
        if self.interpolation == "steps" and (gaps < SHORTEST_STEP).any():
            where = int(np.argmin(gaps))
            return (
                f"times: the step at {self.times[where]:g} s lasts {gaps[where]:.3g} s. Allowed: {SHORTEST_STEP} s or "
                'more, in which a vehicle can settle. Give longer steps, or interpolation = "smooth".'
            )
        return None

    def _table(self) -> np.ndarray:
        yaws = np.array(self.yaws or [0.0] * len(self.times), float) + self.yaw
        time, values = np.array(self.times, float), np.column_stack([np.array(self.positions, float), yaws])
        table = np.zeros((time.size, 17))
        table[:, 0], table[:, 13:] = time, values
        if self.interpolation == "smooth":
            ends = "clamped" if self.ends == "at_rest" else "not-a-knot"
            table[:-1, 1:] = np.moveaxis(CubicSpline(time, values, bc_type=ends).c, 0, 1).reshape(-1, 16)
        return table

    def _at(self, time: Any, xp: Any) -> Components:
        """x, y, z and yaw at a time."""
        rows = self.table
        if xp is np:
            row = rows[np.searchsorted(rows[:, 0], time, side="right") - 1].T
        elif rows.size > LARGEST:
            row = rows[jnp.sum(rows[:, 0] <= time) - 1]
        else:  # a kernel compares with all of them
            here = jnp.arange(len(rows)) == jnp.sum(jnp.where(rows[:, 0] <= time, 1, 0)) - 1
            row = jnp.sum(jnp.where(here[:, None], rows, 0.0), axis=0)
        elapsed = time - row[0]
        parts = (row[1 + axis :: 4] for axis in range(4))
        return tuple(((a * elapsed + b) * elapsed + c) * elapsed + d for a, b, c, d in parts)


def read_target(target: Mapping[str, Any], folder: File, where: str = "") -> dict[str, Any]:
    """The table of waypoints for a table with `kind = "csv"`.

    Args:
        target: the table.
        folder: what a relative path starts from.
        where: the beginning of a message.

    Raises:
        BadInput: no file, or one that holds no path; the line says what is missing.
    """
    known = ("kind", "file", "yaw", "interpolation", "ends", "feed_forward")
    for key in target:
        if key not in known:
            raise BadInput(f"{where}target.{key}: no such field of a csv. Fields here: {', '.join(known)}.")
    if not isinstance(target.get("file"), str):
        raise BadInput(f"{where}target.file: missing. Allowed: a file with the columns {', '.join(COLUMNS)}.")
    file = folder / File(target["file"]).expanduser()
    kept = {key: value for key, value in target.items() if key not in ("kind", "file")}
    return {
        "kind": "waypoints",
        "interpolation": "smooth",
        "ends": "free",
        **kept,
        **_read(file, f"{where}target.file: {file}"),
    }


def _read(file: File, where: str) -> dict[str, Any]:
    """times, positions and yaws of a file."""
    try:
        with file.open(newline="", encoding="utf-8-sig") as text:
            rows = [row for row in csv.reader(text) if any(cell.strip() for cell in row)]
    except OSError as error:
        raise BadInput(f"{where}: cannot be read ({error.strerror}). Give a CSV file.") from None
    except (UnicodeDecodeError, csv.Error):
        raise BadInput(f"{where}: is no CSV file. Give one with the columns {', '.join(COLUMNS)}.") from None
    names = [name.strip().lower() for name in rows[0]] if rows else []
    lacking = [name for name in COLUMNS[:4] if name not in names]
    if lacking:
        raise BadInput(
            f"{where}: has no column {', '.join(lacking)}. Its first row has to name t, x, y, z and, where wanted, yaw."
        )
    columns = {name: names.index(name) for name in COLUMNS if name in names}
    if not 2 <= len(rows) - 1 <= MOST:
        raise BadInput(f"{where}: has {len(rows) - 1} rows of numbers. Allowed: 2 to {MOST}.")
    numbers = np.array([[_number(row, place, f"{where}: row {line}: {name}") for name, place in columns.items()]
                        for line, row in enumerate(rows[1:], start=2)])  # fmt: skip
    time, steps = numbers[:, 0], np.diff(numbers[:, 0])
    if (steps <= 0).any():
        line = int(np.argmax(steps <= 0))
        raise BadInput(
            f"{where}: row {line + 3}: t goes from {time[line]:g} to {time[line + 1]:g} s. Allowed: rising times."
        )
    if (steps > LARGEST_GAP * np.median(steps)).any():
        line = int(np.argmax(steps))
        raise BadInput(
            f"{where}: row {line + 3}: no sample for {steps[line]:.3g} s, where rows are {np.median(steps):.3g} s "
            f"apart. Allowed: up to {LARGEST_GAP} times that. Fill the gap, or write kind = "
            '"waypoints" with times and positions.'
        )
    if "yaw" in columns and (large := np.abs(numbers[:, 4]) > LARGEST_YAW).any():
        line = int(np.argmax(large))
        raise BadInput(
            f"{where}: row {line + 2}: yaw: {numbers[line, 4]:g} is not allowed. Allowed: -{LARGEST_YAW} to "
            f"{LARGEST_YAW} rad. Is it in deg? Then write {math.radians(numbers[line, 4]):.4g}."
        )
    found = {"times": (time - time[0]).round(9).tolist(), "positions": numbers[:, 1:4].tolist()}
    return found | ({"yaws": np.unwrap(numbers[:, 4]).tolist()} if "yaw" in columns else {})


def _number(row: list[str], place: int, where: str) -> float:
    text = row[place].strip() if place < len(row) else ""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise BadInput(f"{where}: {text!r} is no number. Fill the gap, or leave the row out.")
    return value
