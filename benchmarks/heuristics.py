"""The sensitivities as a drawing and as tables, beside the paper's claims about each parameter (H1 to H11).

Written into the documentation by `python benchmarks/sensitivity.py --docs`.
"""

import math
from pathlib import Path
from typing import Any

import matplotlib as mpl
from matplotlib.figure import Figure

from flytune.report.style import HAIRLINE, QUIET, TRIALS
from flytune.tables import Cell, Table
from flytune.tuning.sensitivity import Point, Sensitivities

MEASURES = (
    ("settling_time", "settling time [s]", 1.0),
    ("overshoot", "overshoot [%]", 100.0),
    ("error", "error [mm]", 1e3),
)

# item, claim, parameter, measure, claimed direction of the measure where the parameter is raised, axis
CLAIMS = (
    ("H1, H2", "survival up: bolder, faster", "reward.survival.reward", "settling_time", "down", "position"),
    ("H3", "horizontal delta up: faster", "reward.horizontal.wide", "settling_time", "down", "position"),
    ("H3", "vertical delta up: faster in height", "reward.vertical.sharpness", "settling_time", "down", "z"),
    ("H4", "share of the wide term up: less accurate", "reward.horizontal.share", "error", "up", "position"),
    ("H5", "sharper beta: more accurate", "reward.horizontal.narrow", "error", "down", "position"),
    ("H6", "velocity weight up: slower", "reward.velocity.weight", "settling_time", "up", "position"),
    ("H6", "velocity weight up: damped", "reward.velocity.weight", "overshoot", "down", "position"),
    ("H6", "velocity sharpness up: slower", "reward.velocity.sharpness", "settling_time", "up", "position"),
    ("H6", "velocity sharpness up: damped", "reward.velocity.sharpness", "overshoot", "down", "position"),
    ("H7", "speed bound up: faster", "termination.speed.bound", "settling_time", "down", "position"),
    ("H8", "smoothness weight up: larger error", "reward.smoothness.weight", "error", "up", "position"),
    ("H8, H9", "rate bound up: smaller error", "termination.body_rate.bound_deg_per_s", "error", "down", "position"),
)


def heuristics_tables(sensitivities: Sensitivities) -> str:
    """The outcome of each claim, then one table per parameter, as Markdown."""
    rows = []
    for item, claim, parameter, measure, direction, axis in CLAIMS:
        points = sensitivities.parameters[parameter].points
        ends = [_said(measure, point.median(measure, axis)) for point in (points[0], points[-1])]
        outcome = sensitivities.check_claim(parameter, measure, direction, axis)  # pyright: ignore[reportArgumentType]
        span = f"{points[0].value:g} to {points[-1].value:g}"
        rows.append(
            (item, claim, f"`{parameter}` {span}", f"{ends[0]} to {ends[1]}", Cell(text=outcome, tone="strong"))
        )
    parts = [
        "## The paper's claims",
        Table.plain(("item", "claim", "parameter", "measured", "outcome"), rows).markdown(),
        "## Every parameter",
    ]
    for parameter, curve in sensitivities.parameters.items():
        parts.append(f"### `{parameter}`, {curve.baseline:g} in the baseline")
        parts.append(
            Table.plain(
                ("value", "settled", *(title for _, title, _ in MEASURES), "speed bound crossed"),
                [_row(point, curve.baseline) for point in curve.points],
            ).markdown()
        )
    return "\n\n".join(parts) + "\n"


def draw_sensitivities(path: Path, sensitivities: Sensitivities) -> None:
    """Write the sensitivities as SVG: one row per measure, one column per parameter, median and range of the seeds."""
    with mpl.rc_context(
        {"svg.fonttype": "none", "svg.hashsalt": "flytune", "font.size": 8, "font.family": "sans-serif"}
    ):
        parameters = list(sensitivities.parameters.items())
        figure = Figure(figsize=(2.1 * len(parameters), 6.0), layout="constrained")
        grid: Any = figure.subplots(len(MEASURES), len(parameters), sharey="row", squeeze=False)
        for column, (parameter, curve) in enumerate(parameters):
            points = [point for point in curve.points if point.value > 0]
            for row, (measure, title, scale) in enumerate(MEASURES):
                panel = grid[row][column]
                values = [point.value for point in points]
                numbers = [[scale * n if math.isfinite(n) else math.nan for n in p.numbers(measure)] for p in points]
                middles = [scale * p.median(measure) if math.isfinite(p.median(measure)) else math.nan for p in points]
                panel.fill_between(
                    values, [min(n) for n in numbers], [max(n) for n in numbers], color=TRIALS[row], alpha=0.18, lw=0
                )
                panel.plot(values, middles, color=TRIALS[row], marker="o", markersize=3, linewidth=1.1)
                panel.axvline(curve.baseline, color=QUIET, linewidth=0.8, linestyle=":")
                panel.set_xscale("log")
                panel.grid(color=HAIRLINE, linewidth=0.6)
                panel.spines[["top", "right"]].set_visible(False)
                panel.minorticks_off()
                panel.set_xticks(values, [f"{value:g}" for value in values], rotation=60)
                if measure == "settling_time":
                    panel.set_title(parameter.replace(".", "\n", 1), fontsize=8)
                if column == 0:
                    panel.set_ylabel(title)
        figure.savefig(path, format="svg", metadata={"Date": None})


def _row(point: Point, baseline: float) -> tuple[str | Cell, ...]:
    settled = [result.settled for result in point.seeds]
    crossed = [sum(n for name, n in result.violations.items() if "speed" in name) for result in point.seeds]
    value = Cell(text=f"{point.value:g}", tone="strong" if point.value == baseline else "")
    cells = []
    for measure, _, scale in MEASURES:
        numbers = point.numbers(measure)
        ends = [f"{scale * n:.3g}" if math.isfinite(n) else "-" for n in (min(numbers), max(numbers))]
        middle = point.median(measure)
        cells.append(
            f"{scale * middle:.3g} ({ends[0]} to {ends[1]})" if math.isfinite(middle) else f"- ({ends[0]} to {ends[1]})"
        )
    return (value, ", ".join(map(str, settled)), *cells, ", ".join(map(str, crossed)))


def _said(measure: str, value: float) -> str:
    if not math.isfinite(value):
        return "never"
    return {"settling_time": f"{value:.2f} s", "overshoot": f"{100 * value:.1f} %", "error": f"{1e3 * value:.1f} mm"}[
        measure
    ]
