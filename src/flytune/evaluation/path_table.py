"""The tables of targets that move: how well they are tracked, and the response to each step."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

from flytune.tables import Column, Table


def path_tables(several: Sequence[Mapping[str, Any]]) -> list[Table]:
    """Of targets that move, the table of tracking, a row per judgement; of those that step, a table of their steps."""
    tracked = [judged for judged in several if judged.get("tracking")]
    tables = [Table.of(TRACKING, tracked)] if tracked else []
    for judged in several:
        if judged.get("steps"):
            steps = [{**step, "trials": judged["trials"]} for step in judged["steps"]]
            heading = Column(judged["who"], _begin, align="left", width=10)
            tables.append(Table.of((heading, *STEPS), steps))
    return tables


def _begin(step: Mapping[str, Any]) -> str:
    return f"at {step['begin']:g} s"


def _target(step: Mapping[str, Any]) -> str:
    *place, yaw = step["target"]
    turned = f", {math.degrees(yaw):.4g} deg" if yaw else ""
    return f"  {', '.join(f'{value:g}' for value in place)} m{turned}"


def _lag(judged: Mapping[str, Any]) -> float | None:
    lag = judged["tracking"]["lag"]["median"]
    return None if lag is None else round(lag, 3) + 0.0  # never -0


TRACKING = (
    Column("tracking", lambda judged: judged["who"], align="left", width=10),
    *(Column(title, lambda judged, key=key: judged["tracking"][key]["median"], group="error [mm]", decimals=1,
             scale=1e3, width=9)
      for title, key in (("mean", "mean_error"), ("p95", "p95_error"), ("max", "maximum_error"),
                         ("along", "along_error"), ("across", "across_error"))),
    Column("[s]", _lag, group="lag", decimals=3, width=9),
    Column("after [s]", lambda judged: judged["tracking"]["begin"], decimals=1, width=11),
)  # fmt: skip

STEPS = (
    Column("  step to", _target, align="left", width=26),
    Column("", lambda step: f"{step['position']['settled']}/{step['trials']}", group="settled", width=9),
    Column("median", lambda step: step["position"]["settling_time"]["median"], group="settling time [s]", decimals=2,
           width=11),
    Column("p95", lambda step: step["position"]["settling_time"]["p95"], group="settling time [s]", decimals=2,
           width=9),
    Column("median", lambda step: step["position"]["overshoot"]["median"], group="overshoot [%]", decimals=1,
           scale=100.0, width=10),
    Column("p95", lambda step: step["position"]["overshoot"]["p95"], group="overshoot [%]", decimals=1, scale=100.0,
           width=6),
    Column("[mm]", lambda step: step["position"]["steady_state_error"]["median"], group="error", decimals=1, scale=1e3,
           width=9),
)  # fmt: skip
