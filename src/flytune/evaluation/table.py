"""The response table, one row per channel, for a terminal, a page and Markdown; and the judgement in one line.

All of it is written from `Judgement.to_dict`, with '-' where a quantile is infinite.
"""

import math
from collections.abc import Mapping
from typing import Any

from flytune.evaluation.path_table import path_tables
from flytune.tables import Column, Table, number

AXES = ("x", "y", "z", "yaw")

COLUMNS = (
    Column("", lambda row: row["channel"], align="left", width=10),
    Column("", lambda row: row["settled"], group="settled", width=9),
    Column("median", lambda row: row["settling_time"]["median"], group="settling time [s]", decimals=2, width=11),
    Column("p95", lambda row: row["settling_time"]["p95"], group="settling time [s]", decimals=2, width=9),
    Column("median", lambda row: row["rise_time"]["median"] if "rise_time" in row else "", group="rise [s]",
           decimals=2, width=11),
    Column("median", lambda row: row["overshoot"]["median"], group="overshoot [%]", decimals=1, scale=100.0, width=10),
    Column("p95", lambda row: row["overshoot"]["p95"], group="overshoot [%]", decimals=1, scale=100.0, width=6),
    Column("median", lambda row: row["error"]["median"], group="   steady-state error", width=9),
    Column("p95", lambda row: row["error"]["p95"], group="   steady-state error", width=10),
    Column("", lambda row: row["unit"], align="left", width=0),
)  # fmt: skip


def error_unit(channel: str) -> tuple[str, float, int]:
    """The unit in which steady-state errors of a channel are shown, its factor, and the decimals."""
    return ("deg", math.degrees(1), 2) if channel == "yaw" else ("mm", 1e3, 1)


def response_table(judged: Mapping[str, Any]) -> Table:
    """The response table of one judgement, one row per channel."""
    channels = {**judged["axes"], "position": judged["position"]}
    return Table.of(COLUMNS, [_row(name, channel, judged["trials"]) for name, channel in channels.items()])


def _row(name: str, channel: Mapping[str, Any], trials: int) -> dict[str, Any]:
    unit, scale, decimals = error_unit(name)
    error = {level: number(value, decimals, scale) for level, value in channel["steady_state_error"].items()}
    settled = f"{channel['settled']}/{trials}"
    return {**channel, "channel": name, "settled": settled, "error": error, "unit": f" {unit}"}


def response_text(judged: Mapping[str, Any]) -> str:
    """One judgement for a terminal: its conditions, the response table, and what does not belong to one channel."""
    dial = "".join(f", dial {name} {_shown(value)}" for name, value in (judged.get("dial") or {}).items())
    made_for = f", made for {judged['made_for']}" if judged.get("made_for") else ""
    made_for += met_words(judged.get("set") or {})
    heading = (
        f"{judged['who']} on {judged['task']} ({judged['vehicle']}{made_for}, world {judged['world']}{dial}): "
        f"{judged['trials']} trials of {judged['duration']:g} s, starts {judged['starts']}, seed {judged['seed']}"
    )
    if judged["seed"] is None:  # logged elsewhere
        trials = "1 flight" if judged["trials"] == 1 else f"{judged['trials']} flights"
        heading = f"{judged['who']}: {trials} of {judged['duration']:g} s, {judged['starts']}"
    crossed = ", ".join(f"{name} {count}" for name, count in judged["violations"].items()) or "none"
    small = {axis: judged["axes"][axis]["small_steps"] for axis in AXES}
    peak, action = judged["peak_speed"], judged["action"]
    footer = [
        f"crashed {judged['crashed']}   infeasible {judged['infeasible']}   trials that crossed a bound: {crossed}",
        f"peak speed {number(peak['median'], 2)} m/s (p95 {number(peak['p95'], 2)})   action rms "
        f"{number(action['rms'], 3)}, total variation {number(action['total_variation'], 4)}   "
        f"efficiency {number(judged['efficiency']['median'], 2)}",
    ]
    if any(small.values()):
        told = ", ".join(f"{axis} {count}" for axis, count in small.items())
        footer.append(f"steps too small for overshoot and rise: {told}")
    tables = [response_table(judged), *path_tables([judged])]
    return "\n".join([heading, "", *(f"{table.text()}\n" for table in tables), *footer])


def met_words(changes: Mapping[str, Any]) -> str:
    """What a controller met in place of what it was told, for a heading."""
    return "".join(f", met {path}={value}" for path, value in changes.items())


def _shown(setting: Any) -> str:
    """The value of a dial, or its values and the times at which it is turned to them."""
    if not isinstance(setting, list):
        return f"{setting:g}"
    return ", ".join(f"{value:g} from {time:g} s on" for time, value in setting)


def response_line(judged: Mapping[str, Any]) -> str:
    """The judgement in one line: settled trials per axis, then medians over all trials."""
    settled = ", ".join(f"{judged['axes'][axis]['settled']}/{judged['trials']} {axis}" for axis in AXES)
    position, yaw = judged["position"], judged["axes"]["yaw"]
    return (
        f"settled {settled}   settling {number(position['settling_time']['median'], 1)} s (median)   "
        f"error {number(position['steady_state_error']['median'], 1, 1e3)} mm, "
        f"{number(yaw['steady_state_error']['median'], 2, math.degrees(1))} deg   "
        f"peak {number(judged['peak_speed']['median'], 2)} m/s"
    )
