"""The response table, one row per channel, for a terminal, a page and Markdown; and the judgement in one line.

Everything is written from what `Judgement.to_dict` gives, '-' where a quantile is infinite.
"""

import dataclasses
import math
from collections.abc import Mapping
from typing import Any

from flytune.tables import Column, Table, number

AXES = ("x", "y", "z", "yaw")


@dataclasses.dataclass(frozen=True)
class _Channel:
    """One row: a channel of a judgement, and the unit its error is written in."""

    name: str
    trials: int
    judged: Mapping[str, Any]

    @property
    def unit(self) -> str:
        return "deg" if self.name == "yaw" else "mm"

    def error(self, level: str) -> str:
        scale, decimals = (math.degrees(1), 2) if self.unit == "deg" else (1e3, 1)
        return number(self.judged["steady_state_error"][level], decimals, scale)


COLUMNS = (
    Column("", lambda row: row.name, align="left", width=10),
    Column("", lambda row: f"{row.judged['settled']}/{row.trials}", group="settled", width=9),
    Column("median", lambda row: row.judged["settling_time"]["median"], group="settling time [s]", decimals=2,
           width=11),
    Column("p95", lambda row: row.judged["settling_time"]["p95"], group="settling time [s]", decimals=2, width=9),
    Column("median", lambda row: row.judged["rise_time"]["median"] if "rise_time" in row.judged else "",
           group="rise [s]", decimals=2, width=11),
    Column("median", lambda row: row.judged["overshoot"]["median"], group="overshoot [%]", decimals=1, scale=100.0,
           width=10),
    Column("p95", lambda row: row.judged["overshoot"]["p95"], group="overshoot [%]", decimals=1, scale=100.0, width=6),
    Column("median", lambda row: row.error("median"), group="   steady-state error", width=9),
    Column("p95", lambda row: row.error("p95"), group="   steady-state error", width=10),
    Column("", lambda row: f" {row.unit}", align="left", width=0),
)  # fmt: skip


def response_table(judged: Mapping[str, Any]) -> Table:
    """The response table of one judgement, one row per channel."""
    channels = {axis: judged["axes"][axis] for axis in AXES} | {"position": judged["position"]}
    return Table.of(COLUMNS, [_Channel(name, judged["trials"], channel) for name, channel in channels.items()])


def response_text(judged: Mapping[str, Any]) -> str:
    """One judgement for a terminal: what flew where, the response table, and what does not belong to one channel."""
    heading = (
        f"{judged['who']} on {judged['task']} ({judged['vehicle']}, world {judged['world']}): "
        f"{judged['trials']} trials of {judged['duration']:g} s, starts {judged['starts']}, seed {judged['seed']}"
    )
    crossed = ", ".join(f"{name} {count}" for name, count in judged["violations"].items()) or "none"
    small = ", ".join(f"{axis} {judged['axes'][axis]['small_steps']}" for axis in AXES)
    peak, action = judged["peak_speed"], judged["action"]
    footer = [
        f"crashed {judged['crashed']}   infeasible {judged['infeasible']}   trials that crossed a bound: {crossed}",
        f"peak speed {number(peak['median'], 2)} m/s (p95 {number(peak['p95'], 2)})   action rms "
        f"{number(action['rms'], 3)}, total variation {number(action['total_variation'], 4)}   "
        f"efficiency {number(judged['efficiency']['median'], 2)}",
        f"steps too small for overshoot and rise: {small}",
    ]
    return "\n".join([heading, "", response_table(judged).text(), "", *footer])


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
