"""Which columns of a log are time, position, heading, velocity and target, and in which units.

The names are those of plain tables, of the Crazyflie client (`stateEstimate.x`), of PX4's `ulog2csv` (north, east,
down) and of ROS. A column may also be named by the user. What no name and no unit says is asked for, not guessed.
"""

import dataclasses
import re
from collections.abc import Mapping, Sequence
from typing import Any

from flytune.errors import BadInput
from flytune.evaluation.log_table import LogTable

TARGET_WORDS = "target|ref|reference|setpoint|sp|des|desired|goal|cmd"
# words of columns that are something else than a state
OTHER = re.compile(rf"(^|_)({TARGET_WORDS}|ctrltarget|std|var|cov|rate|error|err|delta|raw|valid|reset|counter)(_|$)")
PX4 = {
    "xy_valid",
    "z_valid",
    "v_xy_valid",
    "ref_timestamp",
    "dist_bottom",
    "delta_xy_0",
    "pose_frame",
    "timestamp_sample",
}

# groups of quantities that one program logs together, and the names by which each is known, the surest first;
# {a} is the axis, {i} its number, {k} the number of a quaternion's component with w first
GROUPS: dict[tuple[str, ...], tuple[str, ...]] = {
    ("time",): ("t|time|timestamp", "(.*_)?(timestamp|time|stamp|seconds|secs?)"),
    ("x", "y", "z"): (
        "{a}", "(p|pos|position)_?{a}|{a}_?pos(ition)?", "stateestimate_{a}", "stateestimatez_{a}", "kalman_state{a}",
        "(.*_)?(pos|position|translation)_({a}|{i})",
    ),
    ("qx", "qy", "qz", "qw"): (
        "q_?{a}", "(quat|quaternion|orientation)_?{a}", "stateestimate_q{a}", "kalman_q{k}",
        "(.*_)?(quat|quaternion|orientation|rotation)_{a}",
    ),
    ("yaw",): ("yaw|psi|heading", "stateestimate_yaw", "stabilizer_yaw", "(.*_)?(yaw|psi|heading)"),
    ("vx", "vy", "vz"): (
        "v_?{a}", "(vel|velocity)_?({a}|{i})", "stateestimate_v{a}", "(.*_)?(vel|velocity|linear)_({a}|{i})",
    ),
    ("target_x", "target_y", "target_z"): (
        f"({TARGET_WORDS})_?(pos_|position_)?{{a}}", f"{{a}}_?({TARGET_WORDS})", "ctrltarget_{a}",
        f"(.*_)?({TARGET_WORDS})_(pos_|position_)?{{a}}",
    ),
    ("target_yaw",): (
        f"({TARGET_WORDS})_?yaw", f"yaw_?({TARGET_WORDS})", "ctrltarget_yaw", f"(.*_)?({TARGET_WORDS})_yaw",
    ),
    ("trial",): ("trial(_id)?|episode|flight|run",),
}  # fmt: skip
PX4_QUATERNION = "(.*_)?q_{k}"  # PX4 writes w first
QUANTITIES = tuple(name for group in GROUPS for name in group)
OF_LAYOUT = {"stateestimate_yaw": "deg", "stabilizer_yaw": "deg", "ctrltarget_yaw": "deg"}  # units that programs fix

LENGTHS = {"m": 1.0, "cm": 0.01, "mm": 0.001, "ft": 0.3048}
ANGLES = {"rad": 1.0, "deg": 0.017453292519943295, "°": 0.017453292519943295, "degrees": 0.017453292519943295}
TIMES = {"s": 1.0, "sec": 1.0, "ms": 1e-3, "msec": 1e-3, "us": 1e-6, "µs": 1e-6, "usec": 1e-6, "ns": 1e-9}
SPEEDS = {"m/s": 1.0, "cm/s": 0.01, "mm/s": 0.001}
UNIT = re.compile(r"^(.*?)\s*[\[(]\s*([^\[\]()]+?)\s*[\])]$")
SUFFIX = re.compile(r"^(.+)_(m|cm|mm|rad|deg|s|sec|ms|us|ns)$", re.IGNORECASE)


@dataclasses.dataclass(frozen=True)
class Column:
    """Where the values of one quantity come from: a column of the file, or a constant."""

    name: str  # in the file
    index: int | None  # None for a constant
    unit: str = ""  # empty where nothing says it
    sign: float = 1.0
    constant: float = 0.0

    def __str__(self) -> str:
        minus = "-" if self.sign < 0 else ""
        return f"{minus}{self.name}" + (f" [{self.unit}]" if self.unit and not _bracketed(self.name) else "")


def units_of(quantity: str) -> dict[str, float]:
    """The units that a quantity may have, and the SI value of each."""
    if quantity == "time":
        return TIMES
    if quantity.endswith("yaw"):
        return ANGLES
    if quantity in ("vx", "vy", "vz"):
        return SPEEDS
    return LENGTHS if quantity.removeprefix("target_") in ("x", "y", "z") else {}


def choose_columns(table: LogTable, given: Mapping[str, str]) -> tuple[dict[str, Column], bool]:
    """The column of each quantity that the log has, and whether its frame is that of PX4 (north, east, down).

    Args:
        table: the log.
        given: quantity -> name of its column, with a unit in brackets and a minus sign where wanted, or a number.

    Raises:
        BadInput: a name that is not there, or two columns that fit one quantity.
    """
    chosen = {quantity: _given(table, quantity, text) for quantity, text in given.items()}
    plain = [_plain(name) for name in table.header]
    px4 = len(PX4 & set(plain)) > 0 and not {"x", "y", "z"} & set(given)
    for group, ranks in GROUPS.items():
        wanted = [quantity for quantity in group if quantity not in chosen]
        if not wanted:
            continue
        for pattern in (PX4_QUATERNION, *ranks) if px4 and "qw" in group else ranks:
            found = {quantity: _matches(plain, quantity, pattern) for quantity in wanted}
            if not all(found.values()):
                continue
            for quantity, indices in found.items():
                if len(indices) > 1:
                    names = " and ".join(table.header[index] for index in indices[:3])
                    raise BadInput(
                        f"{table.path}: {quantity}: the columns {names} both fit. Give --columns "
                        f"'{quantity}={table.header[indices[0]]}'."
                    )
                chosen[quantity] = _found(table, quantity, indices[0], plain[indices[0]])
            break
    return chosen, px4


def check_columns(table: LogTable, chosen: Mapping[str, Any], needed: Sequence[str]) -> None:
    """Refuse a log that lacks a quantity; the line says which columns there are, and what to give.

    Raises:
        BadInput: it does.
    """
    missing = [quantity for quantity in needed if quantity not in chosen]
    if not missing:
        return
    there = ", ".join(table.header[:30]) + (", ..." if len(table.header) > 30 else "")
    give = " ".join(f"'{quantity}=COLUMN'" for quantity in missing)
    number = (
        " Or name the quaternion, qx, qy, qz, qw; or give a constant, for instance yaw=0." if "yaw" in missing else ""
    )
    raise BadInput(f"{table.path}: no column is {', '.join(missing)}. Found: {there}. Give --columns {give}.{number}")


def _given(table: LogTable, quantity: str, text: str) -> Column:
    if quantity not in QUANTITIES:
        raise BadInput(f"columns: {quantity!r} is not allowed. Allowed: {', '.join(QUANTITIES)}.")
    text = text.strip()
    for sign, name in ((1.0, text), (-1.0, text.removeprefix("-"))):
        if name in table.header and (sign > 0 or text.startswith("-")):
            index = table.header.index(name)
            return dataclasses.replace(_found(table, quantity, index, _plain(name)), sign=sign)
        match = UNIT.match(name)
        if match and match[1] in table.header and (sign > 0 or text.startswith("-")):
            unit = match[2]
            if unit not in units_of(quantity):
                allowed = ", ".join(units_of(quantity)) or "none"
                raise BadInput(f"columns: {quantity}: the unit {unit!r} is not allowed. Allowed: {allowed}.")
            return Column(match[1], table.header.index(match[1]), unit, sign)
    try:
        return Column(text, None, constant=float(text))
    except ValueError:
        there = ", ".join(table.header[:30]) + (", ..." if len(table.header) > 30 else "")
        raise BadInput(
            f"columns: {quantity}: {table.path} has no column {text!r}. Allowed: {there}; or a number."
        ) from None


def _found(table: LogTable, quantity: str, index: int, plain: str) -> Column:
    """A column with the unit that its name, the row below the header, or the program says."""
    name, known = table.header[index], units_of(quantity)
    match, suffix = _bracketed(name), SUFFIX.match(name)
    said = (match[2] if match else "") or table.units[index] or (suffix[2] if suffix else "")
    fixed = OF_LAYOUT.get(plain, "mm" if plain.startswith("stateestimatez_") and known is LENGTHS else "")
    if known is LENGTHS and plain.startswith(("stateestimate_", "kalman_", "ctrltarget_")):
        fixed = "m"
    unit = next((unit for unit in (said, said.lower()) if unit in known), "")
    if match and known and not unit:
        raise BadInput(
            f"{table.path}: {name}: the unit {match[2]!r} is not allowed for {quantity}. Allowed: {', '.join(known)}. "
            "Change it in the header."
        )
    return Column(name, index, unit or fixed)


def _bracketed(name: str) -> re.Match[str] | None:
    """The name and the unit of `x [m]`; `q[0]` has no unit."""
    match = UNIT.match(name)
    return match if match and not match[2].isdigit() else None


def _plain(name: str) -> str:
    """A name without its unit, in lower case, with underscores between its words."""
    name = match[1] if (match := _bracketed(name)) else name
    name = re.sub(r"[^0-9a-z]+", "_", name.lower()).strip("_")
    return match[1] if (match := SUFFIX.match(name)) else name


def _matches(plain: Sequence[str], quantity: str, pattern: str) -> list[int]:
    axis = quantity[-1]
    numbers = {"a": axis, "i": "xyz".find(axis), "k": "wxyz".find(axis)}
    wanted = re.compile(pattern.format(**numbers) if "{" in pattern else pattern)
    state = not quantity.startswith("target")
    return [index for index, name in enumerate(plain) if wanted.fullmatch(name) and not (state and OTHER.search(name))]
