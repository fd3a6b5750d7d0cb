"""Reading flights: what `evaluate --flights` writes, arrays of a user's own, and logs in text."""

import zipfile
import zlib
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from flytune.config.recognise import FLIGHTS, meant, misplaced
from flytune.errors import BadInput
from flytune.evaluation.flights import Flights
from flytune.evaluation.log_columns import TIMES, Column, check_columns, choose_columns, units_of
from flytune.evaluation.log_table import DELIMITERS, LARGEST, LogTable, open_log
from flytune.evaluation.logged import flights_from, joined
from flytune.evaluation.resampling import LONGEST_GAP

ARRAYS = ("position", "yaw", "attitude", "velocity", "body_rate", "rotor_speed_rpm", "action")
QUATERNION = ("qx", "qy", "qz", "qw")
TARGET = ("target_x", "target_y", "target_z", "target_yaw")
RATES, DURATIONS = (2.0, 5000.0), (1.0, 7200.0)  # Hz and s, of a log whose unit of time nothing says
FARTHEST = 100.0  # m; a position without a unit that reaches farther is probably in another one
UNREADABLE = (OSError, EOFError, ValueError, KeyError, IndexError, TypeError, zipfile.BadZipFile, zlib.error)
STILL = 1e-6  # m and rad; a target that changes by less stays the same
MOST_STEPS = 50  # of the target in one log; one that changes more often follows a path

Say = Callable[[str], None]


def load_flights(
    *paths: str | Path,
    columns: Mapping[str, str] | None = None,
    target: Sequence[float] | None = None,
    start: float | None = None,
    longest_gap: float = LONGEST_GAP,
    on_message: Say = lambda line: None,
) -> Flights:
    """Flights from one file or several: what `evaluate --flights` wrote, arrays in .npz, or logs as text, for `judge`.

    Args:
        paths: the files; each text file is one flight, unless it has a column `trial`.
        columns: of a text file, quantity -> column, for instance {"x": "pos_n[mm]", "z": "-down", "yaw": "0"}; those
            that are not given are found by their names.
        target: x, y, z in m and yaw in rad; where None, the file says it.
        start: s after the first row at which the step begins; where None, the instant at which the target in the file
            changes, or the first row.
        longest_gap: s without a sample over which is interpolated.
        on_message: called with a line on each thing that was found or done.

    Raises:
        BadInput: a file cannot be used; the line says what was found, and what to give.
    """
    if not paths:
        raise BadInput("FILE: is missing. Give a .csv log or an .npz file.")
    if start is not None and not (np.isfinite(start) and start >= 0):
        raise BadInput(f"start: {start} is not allowed. Allowed: 0 or more seconds after the first row.")
    if not (np.isfinite(longest_gap) and longest_gap > 0):
        raise BadInput(f"gap: {longest_gap} is not allowed. Allowed: more than 0 s.")
    aim = None if target is None else _checked_target(target)
    flights = []
    for path in map(Path, paths):
        if line := misplaced(str(path), FLIGHTS):
            raise BadInput(line)
        if _is_zip(path):
            flights.append(_from_npz(path, columns, aim, start, longest_gap, on_message))
        else:
            flights += _from_text(path, columns or {}, aim, start, longest_gap, on_message)
    return flights[0] if len(flights) == 1 else joined(flights, " ".join(map(str, paths)), on_message)


def _checked_target(target: Sequence[float]) -> np.ndarray:
    aim = np.asarray(target, dtype=np.float64)
    if aim.shape != (4,) or not np.isfinite(aim).all():
        raise BadInput(f"target: {list(target)} is not allowed. Allowed: four numbers x,y,z,yaw in m and rad.")
    if abs(aim[3]) > 2 * np.pi:
        raise BadInput(
            f"target: a yaw of {aim[3]:g} rad is not allowed. Allowed: -6.28 to 6.28 rad. Did you mean "
            f"{np.radians(aim[3]):.4g} ({aim[3]:g} deg)?"
        )
    return aim


def _is_zip(path: Path) -> bool:
    try:
        with path.open("rb") as file:
            return file.read(4) == b"PK\x03\x04"
    except OSError as error:
        hint = meant(str(path), FLIGHTS, [], [".csv", ".npz"])
        raise BadInput(f"{path}: cannot be read ({error.strerror}). Give a .csv log or an .npz file.{hint}") from None


def _from_npz(
    path: Path, columns: Any, aim: np.ndarray | None, start: float | None, longest_gap: float, say: Say
) -> Flights:
    """The flights of an .npz file: those that flytune saved, or from arrays with the names of `flights_from`."""
    names = ", ".join(("time", *ARRAYS, "target_position", "target_yaw"))
    allowed = f"Allowed: what `evaluate --flights` writes, or the arrays {names}."
    try:
        with zipfile.ZipFile(path) as file:
            if sum(part.file_size for part in file.infolist()) > LARGEST:
                raise BadInput(f"{path}: unpacks to more than {LARGEST / 1e9:g} GB. Cut it to the flight.")
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
        if columns:
            raise BadInput(f"columns: are not allowed with {path}, whose arrays have names. Leave out --columns.")
        if {"data", "columns"} <= arrays.keys():
            if aim is not None or start is not None:
                option = "target" if aim is not None else "start"
                raise BadInput(f"{option}: is not allowed with {path}, which holds its own. Leave out --{option}.")
            return Flights.from_arrays(arrays)
    except BadInput:
        raise
    except UNREADABLE as error:
        raise BadInput(f"{path}: is no file of flights ({error}). {allowed}") from None
    missing = [name for name in ("time", "position") if name not in arrays]
    missing += [] if {"yaw", "attitude"} & arrays.keys() else ["yaw"]
    missing += ["target_position"] if aim is None and "target_position" not in arrays else []
    if missing == ["target_position"]:
        raise BadInput(
            f"{path}: has no array target_position. Found: {', '.join(arrays)}. Give --target x,y,z,yaw in m and rad."
        )
    if missing:
        raise BadInput(f"{path}: has no array {', '.join(missing)}. Found: {', '.join(arrays)}. {allowed}")
    for name, values in arrays.items():
        if values.dtype.kind not in "fiub" and name in ("time", "target_position", "target_yaw", *ARRAYS):
            raise BadInput(f"{path}: {name} holds {values.dtype}, not numbers. {allowed}")
    place = arrays["target_position"] if aim is None else aim[:3]
    yaw = float(arrays.get("target_yaw", 0.0)) if aim is None else aim[3]
    given = {name: arrays[name] for name in ARRAYS if name in arrays and not (name == "yaw" and "attitude" in arrays)}
    time = np.asarray(arrays["time"], np.float64)
    if start is not None:
        kept = time >= time[0] + start
        time = time[kept]
        given = {name: values[..., kept] if name == "yaw" else values[..., kept, :] for name, values in given.items()}
    return flights_from(
        time, **given, target_position=place, target_yaw=yaw, name=str(path), longest_gap=longest_gap, on_message=say
    )


def _from_text(
    path: Path, given: Mapping[str, str], aim: np.ndarray | None, start: float | None, longest_gap: float, say: Say
) -> list[Flights]:
    """The flights of a log."""
    table = open_log(path)
    chosen, px4 = choose_columns(table, given)
    if all(name in chosen for name in QUATERNION):
        chosen.pop("yaw", None)
    else:
        chosen = {quantity: column for quantity, column in chosen.items() if quantity not in QUATERNION}
    heading = () if "qw" in chosen else ("yaw",)
    check_columns(table, chosen, ("time", "x", "y", "z", *heading))
    if aim is None and "target_x" not in chosen:
        raise BadInput(f"{path}: no column is a target. Give --target x,y,z,yaw in m and rad.")
    if aim is None:
        check_columns(table, chosen, TARGET)
    else:
        chosen = {quantity: column for quantity, column in chosen.items() if quantity not in TARGET}
    values = _read(table, chosen, say)
    if px4:
        for name in ("y", "z", "yaw", "vy", "vz", "qy", "qz", "target_y", "target_z", "target_yaw"):
            if name in values and chosen[name].index is not None:
                values[name] = -values[name]
        say(f"{path}: PX4's frame (north, east, down) becomes north, west, up: y, z and yaw change their sign")
    trials = values.get("trial")
    parts = [slice(None)] if trials is None else [trials == each for each in dict.fromkeys(trials[~np.isnan(trials)])]
    return [
        _flight(str(path) if len(parts) == 1 else f"{path}, trial {number}", values, part, aim, start, longest_gap, say)
        for number, part in enumerate(parts, start=1)
    ]


def _read(table: LogTable, chosen: dict[str, Column], say: Say) -> dict[str, np.ndarray]:
    """The values of each quantity in SI units."""
    indices = sorted({column.index for column in chosen.values() if column.index is not None})
    numbers = table.read(indices)
    values: dict[str, np.ndarray] = {}
    guessed: list[str] = []
    for quantity, column in chosen.items():
        if column.index is None:
            values[quantity] = np.full(len(numbers), column.constant)
            continue
        raw = numbers[:, indices.index(column.index)]
        known = units_of(quantity)
        if quantity.endswith("yaw") and not column.unit:  # small angles could be degrees as well
            guessed.append(f"{quantity}: nothing says its unit, so it is taken as rad. For degrees, give --columns "
                           f"'{quantity}={column.name}[deg]'")  # fmt: skip
        unit = column.unit or _unit(table, quantity, column, raw) if known else ""
        if quantity == "time" and not column.unit and unit != "s":
            guessed.append(
                f"time: nothing says its unit, so it is taken as {unit}, in which the log has a plausible rate and "
                f"duration. For another unit, give --columns 'time={column.name}[UNIT]'"
            )
        chosen[quantity] = Column(column.name, column.index, unit, column.sign)
        values[quantity] = raw * column.sign * known.get(unit, 1.0)
    taken = ", ".join(f"{quantity} = {column}" for quantity, column in chosen.items())
    say(f"{table.path}: {len(numbers)} rows, {DELIMITERS.get(table.delimiter, table.delimiter)} between cells; {taken}")
    for line in guessed:
        say(f"{table.path}: {line}")
    return values


def _unit(table: LogTable, quantity: str, column: Column, raw: np.ndarray) -> str:
    """The unit of a column that no name says: SI, unless its values say otherwise.

    Raises:
        BadInput: the values do not fit SI units, or no unit of time.
    """
    seen = raw[np.isfinite(raw)]
    give = f"Give --columns '{quantity}={column.name}[UNIT]', with one of {', '.join(units_of(quantity))}."
    if quantity == "time":
        return _unit_of_time(table.path, seen, give)
    largest = float(np.abs(seen).max()) if seen.size else 0.0
    if quantity.endswith("yaw"):
        if largest > 30 or (largest > 2 * np.pi and np.ptp(seen) > 4 * np.pi):
            raise BadInput(f"{table.path}: {column.name} goes to {largest:.4g}, and nothing says its unit. {give}")
        return "rad"
    if quantity in ("vx", "vy", "vz"):
        return "m/s"
    if largest > FARTHEST:
        raise BadInput(f"{table.path}: {column.name} goes to {largest:.4g}, and nothing says its unit. {give}")
    return "m"


def _unit_of_time(path: Path, seen: np.ndarray, give: str) -> str:
    """The one unit of time in which a log has a plausible rate and duration.

    Raises:
        BadInput: there is none, or more than one.
    """
    steps = np.diff(seen)
    step = float(np.median(steps[steps > 0])) if (steps > 0).any() else 0.0
    length = float(np.ptp(seen)) if seen.size else 0.0
    units = {unit: TIMES[unit] for unit in ("s", "ms", "us", "ns")}
    fit = [unit for unit, factor in units.items() if step and _is_within(1 / (step * factor), RATES)
           and _is_within(length * factor, DURATIONS)]  # fmt: skip
    if len(fit) == 1:
        return fit[0]
    near = [unit for unit, factor in units.items() if 1e-5 <= step * factor <= 10]
    words = "; ".join(
        f"in {unit} it is {1 / (step * units[unit]):.4g} Hz for {length * units[unit]:.4g} s" for unit in near
    )
    told = f" ({words})" if words else ""
    raise BadInput(f"{path}: time: a step of {step:g} from row to row fits no unit for sure{told}. {give}")


def _is_within(value: float, limits: tuple[float, float]) -> bool:
    return limits[0] * (1 - 1e-6) <= value <= limits[1] * (1 + 1e-6)


def _flight(
    where: str,
    values: Mapping[str, np.ndarray],
    part: Any,
    aim: np.ndarray | None,
    start: float | None,
    longest_gap: float,
    say: Say,
) -> Flights:
    """One flight from its start to its end, or to the next step of its target."""
    mine = {quantity: column[part] for quantity, column in values.items()}
    time = mine["time"]
    timed = time[np.isfinite(time)]
    if timed.size < 2:
        raise BadInput(f"{where}: has {timed.size} rows with a time. Allowed: 2 or more.")
    begin, end = timed[0] + (start or 0.0), np.inf
    if aim is None:
        aim, begin, end = _step(where, mine, begin, start is not None, say)
    elif start is not None:
        say(f"{where}: the step begins {start:g} s after the first row")
    kept = (time >= begin - 1e-9) & (time < end)
    if np.count_nonzero(kept) < 2:
        raise BadInput(
            f"{where}: has {np.count_nonzero(kept)} samples from {begin - timed[0]:g} s after the first row on. "
            f"Allowed: a start up to {timed[-1] - timed[0] - 2:.2f} s. Give an earlier --start."
        )
    mine = {quantity: column[kept] for quantity, column in mine.items()}

    def together(*names: str) -> np.ndarray | None:
        if not all(name in mine and np.isfinite(mine[name]).any() for name in names):
            return None
        return np.stack([mine[name] for name in names], axis=-1)

    attitude = together(*QUATERNION)
    return flights_from(
        mine["time"],
        np.stack([mine[name] for name in "xyz"], axis=-1),
        yaw=mine.get("yaw") if attitude is None else None,
        attitude=attitude,
        velocity=together("vx", "vy", "vz"),
        target_position=aim[:3],
        target_yaw=float(aim[3]),
        name=where,
        longest_gap=longest_gap,
        on_message=say,
    )


def _step(
    where: str, values: Mapping[str, np.ndarray], begin: float, given: bool, say: Say
) -> tuple[np.ndarray, float, float]:
    """The target of a log, when its step begins, and when the next one begins (infinite without one).

    Raises:
        BadInput: there is no target, or it steps more than once and the user has not said which step counts.
    """
    targets, time = np.stack([values[name] for name in TARGET], axis=-1), values["time"]
    known = np.isfinite(targets).all(axis=1) & np.isfinite(time)
    targets, time = targets[known], time[known]
    if time.size == 0:
        raise BadInput(f"{where}: its target columns are empty. Give --target x,y,z,yaw in m and rad.")
    jumps = time[1:][(np.abs(np.diff(targets, axis=0)) > STILL).any(axis=1)]
    first = values["time"][np.isfinite(values["time"])][0]
    after = [f"{jump - first:.2f}" for jump in jumps]
    if jumps.size > MOST_STEPS:
        raise BadInput(
            f"{where}: its target changes {jumps.size} times, so that it follows a path. Allowed: a target that steps. "
            "Give --target x,y,z,yaw and --start S for a part in which it stays."
        )
    if given:
        begun = np.flatnonzero(time <= begin + 1e-9)
        target, later = targets[begun[-1] if begun.size else 0], jumps[jumps > begin + 1e-9]
    elif jumps.size > 1:
        raise BadInput(
            f"{where}: its target changes {jumps.size} times, {', '.join(after[:8])} s after the first row. Give "
            f"--start S for the step that counts, for instance --start {after[0]}; it ends at the next one."
        )
    else:
        begin = jumps[0] if jumps.size else begin
        target, later = targets[-1], jumps[:0]
    end = later[0] if later.size else np.inf
    until = f", and ends at {end - first:.2f} s, when the target changes" if np.isfinite(end) else ""
    say(f"{where}: the step begins {begin - first:.2f} s after the first row{until}")
    return target, float(begin), float(end)
