"""The judgement as text: a table for a terminal, and one line. Plain, '-' where a quantile is infinite."""

import math

AXES = ("x", "y", "z", "yaw")

HEADER = (
    "            settled   settling time [s]   rise [s]   overshoot [%]   steady-state error",
    "                        median      p95     median    median   p95   median       p95",
)


def response_table(judged: dict) -> str:
    """The table of one judgement, from what `Judgement.to_dict` gives: one row per channel."""
    heading = (
        f"{judged['who']} on {judged['task']} ({judged['vehicle']}, world {judged['world']}): "
        f"{judged['trials']} trials of {judged['duration']:g} s, starts {judged['starts']}, seed {judged['seed']}"
    )
    rows = [_row(axis, judged["trials"], judged["axes"][axis]) for axis in AXES]
    rows.append(_row("position", judged["trials"], judged["position"]))
    return "\n".join([heading, "", *HEADER, *rows, "", *_footer(judged)])


def response_line(judged: dict) -> str:
    """The judgement in one line: settled trials per axis, then medians over all trials."""
    settled = ", ".join(f"{judged['axes'][axis]['settled']}/{judged['trials']} {axis}" for axis in AXES)
    position, yaw = judged["position"], judged["axes"]["yaw"]
    return (
        f"settled {settled}   settling {_number(position['settling_time']['median'], 1)} s (median)   "
        f"error {_number(position['steady_state_error']['median'], 1, 1e3)} mm, "
        f"{_number(yaw['steady_state_error']['median'], 2, math.degrees(1))} deg   "
        f"peak {_number(judged['peak_speed']['median'], 2)} m/s"
    )


def _row(channel: str, trials: int, judged: dict) -> str:
    """One line of the table, under HEADER."""
    scale, unit = (math.degrees(1), "deg") if channel == "yaw" else (1e3, "mm")
    settled, settling, over = f"{judged['settled']}/{trials}", judged["settling_time"], judged["overshoot"]
    rise = _number(judged["rise_time"]["median"], 2) if "rise_time" in judged else ""
    error = [
        _number(judged["steady_state_error"][level], 2 if unit == "deg" else 1, scale) for level in ("median", "p95")
    ]
    return (
        f"{channel:<10}{settled:>9}"
        f"{_number(settling['median'], 2):>11}{_number(settling['p95'], 2):>9}{rise:>11}"
        f"{_number(over['median'], 1, 100.0):>10}{_number(over['p95'], 1, 100.0):>6}"
        f"{error[0]:>9}{error[1]:>10} {unit}"
    )


def _footer(judged: dict) -> list[str]:
    """What does not belong to one channel: failures, then speed, action and efficiency."""
    crossed = ", ".join(f"{name} {count}" for name, count in judged["violations"].items()) or "none"
    small = ", ".join(f"{axis} {judged['axes'][axis]['small_steps']}" for axis in AXES)
    peak, action = judged["peak_speed"], judged["action"]
    return [
        f"crashed {judged['crashed']}   infeasible {judged['infeasible']}   trials that crossed a bound: {crossed}",
        f"peak speed {_number(peak['median'], 2)} m/s (p95 {_number(peak['p95'], 2)})   action rms "
        f"{_number(action['rms'], 3)}, total variation {_number(action['total_variation'], 4)}   "
        f"efficiency {_number(judged['efficiency']['median'], 2)}",
        f"steps too small for overshoot and rise: {small}",
    ]


def _number(value: float | None, decimals: int, scale: float = 1.0) -> str:
    return "-" if value is None else f"{value * scale:.{decimals}f}"
