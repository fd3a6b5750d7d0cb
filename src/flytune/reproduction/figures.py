"""The figures of a reproduction (paper R21) as SVG: for the folder, for the page and for the documentation."""

import dataclasses
import functools
import io
import tomllib
from collections.abc import Callable, Sequence
from importlib import resources
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from flytune.evaluation.judge import Judgement
from flytune.evaluation.table import AXES
from flytune.report.plots import UNITS, course
from flytune.reproduction.evidence import SHOWN, Evidence, Weights
from flytune.reproduction.learning import column
from flytune.reproduction.study import BEHAVIOURS

COLOURS = dict(zip(BEHAVIOURS, ("#0b5fa5", "#d1690e", "#12805c"), strict=True))
WIDTH = 4.6  # inches: one column of a paper, and the width of a phone
STYLE: dict[Any, Any] = {
    "font.size": 8,
    "figure.labelsize": 8,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": "#e4e7eb",
    "grid.linewidth": 0.6,
    "lines.linewidth": 1.0,
    "svg.hashsalt": "flytune",  # the same picture is the same file
    "svg.fonttype": "none",
    "legend.frameon": False,
}
Metric = Callable[[Judgement, str], np.ndarray]


@dataclasses.dataclass(frozen=True, kw_only=True)
class FigureSpec:
    """One figure: its file name, its place on the page, and what to look at."""

    name: str
    section: str
    title: str
    caption: str


_FIGURES_FILE = resources.files("flytune.reproduction") / "figures.toml"
FIGURES = [FigureSpec(**table) for table in tomllib.loads(_FIGURES_FILE.read_text(encoding="utf-8"))["figure"]]


def draw_figures(evidence: Evidence) -> dict[str, str]:
    """Every figure as SVG, by name."""
    drawn = {}
    with mpl.rc_context(STYLE):
        for figure in FIGURES:
            text = io.StringIO()
            DRAWINGS[figure.name](evidence).savefig(text, format="svg", metadata={"Date": None}, bbox_inches="tight")
            drawn[figure.name] = text.getvalue()
    return drawn


def _canvas(rows: int, columns: int, height: float, share_time: bool = False) -> tuple[Figure, Sequence[Axes]]:
    figure = Figure(figsize=(WIDTH, height), layout="constrained")
    return figure, list(np.ravel(figure.subplots(rows, columns, squeeze=False, sharex=share_time)))


def _reward(evidence: Evidence) -> Figure:
    """Episode reward over environment steps, mean over seeds with the band from the least to the greatest."""
    figure, (axes,) = _canvas(1, 1, 2.8)
    for behaviour in BEHAVIOURS:
        curves = evidence.curves[behaviour]
        length = min(map(len, curves))
        steps = column(curves[0], "steps")[:length] / 1e6
        rewards = np.array([column(rows, "episode_reward")[:length] for rows in curves])
        known = np.isfinite(rewards).any(axis=0)
        low, mean, high = (of(rewards[:, known], axis=0) for of in (np.nanmin, np.nanmean, np.nanmax))
        axes.plot(steps[known], mean, color=COLOURS[behaviour], label=behaviour)
        axes.fill_between(steps[known], low, high, color=COLOURS[behaviour], alpha=0.18, linewidth=0)
    axes.set_xlabel("environment steps [millions]")
    axes.set_ylabel("episode reward")
    axes.legend(loc="lower right")
    return figure


def _boxes(
    evidence: Evidence,
    metric: Metric,
    label: str,
    *,
    weights: Weights = "last",
    setting: str,
    logarithmic: bool = False,
) -> Figure:
    """Boxes per axis and behaviour over all seeds and trials; above each, the share of the trials that it shows."""
    figure, panels = _canvas(2, 2, 4.0)
    for axes, axis in zip(panels, AXES, strict=True):
        drawn = False
        for place, behaviour in enumerate(BEHAVIOURS):
            judged = evidence.response(behaviour, weights, setting).judgements
            values = np.concatenate([metric(judgement, axis) for judgement in judged])
            share = _box(axes, values, place, COLOURS[behaviour])
            drawn |= share > 0
            axes.annotate(
                f"{share:.0%}", (place, 1.0), xycoords=("data", "axes fraction"), ha="center", va="bottom", fontsize=6
            )
        axes.set_title(axis, pad=12)
        if logarithmic and drawn:  # a logarithmic axis without a value cannot be drawn
            axes.set_yscale("log")
        else:
            axes.set_ylim(bottom=0)
    figure.supylabel(label)
    return figure


def _box(axes: Axes, values: np.ndarray, place: int, colour: str) -> float:
    """Draw the box of the finite values of a behaviour; the share that they are of all."""
    known = values[np.isfinite(values)]
    axes.boxplot(
        [known],
        positions=[place],
        widths=0.6,
        showfliers=False,
        patch_artist=True,
        boxprops={"facecolor": colour, "alpha": 0.35, "linewidth": 0.6},
        medianprops={"color": colour, "linewidth": 1.4},
        whiskerprops={"linewidth": 0.6},
        capprops={"linewidth": 0.6},
    )
    axes.set_xticks(range(len(BEHAVIOURS)), BEHAVIOURS, fontsize=7)
    axes.set_xlim(-0.6, len(BEHAVIOURS) - 0.4)
    return known.size / values.size


def _profile(evidence: Evidence) -> Figure:
    """x, y, z and yaw against time for the first five tests, three behaviours overlaid, first seed."""
    figure, panels = _canvas(2, 2, 3.8, share_time=True)
    for axes, axis in zip(panels, AXES, strict=True):
        target = band = 0.0
        for behaviour in BEHAVIOURS:
            flights = evidence.response(behaviour, "last", "printed").flights
            values, target, band = course(flights, axis)
            lines = axes.plot(flights.time, values[:SHOWN].T, color=COLOURS[behaviour], linewidth=0.8)
            lines[0].set_label(behaviour)
        axes.axhspan(target - band, target + band, color="#12805c", alpha=0.15, linewidth=0)
        axes.axhline(target, color="#1f2933", linewidth=0.6, linestyle="--")
        axes.set_ylabel(f"{axis} [{UNITS[axis]}]")
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside upper center", ncols=len(BEHAVIOURS))
    for axes in panels[2:]:
        axes.set_xlabel("time [s]")
    return figure


def _rotor_speed(evidence: Evidence) -> Figure:
    """Rotor speed, mean over four motors and five tests, against time: what the paper draws (C6)."""
    figure, (axes,) = _canvas(1, 1, 2.6)
    for behaviour in BEHAVIOURS:
        flights = evidence.response(behaviour, "last", "printed").flights
        speed = flights.rotor_speed_rpm[:SHOWN, 1:].mean(axis=(0, 2))
        axes.plot(flights.time[1:], speed, color=COLOURS[behaviour], linewidth=0.8, label=behaviour)
    axes.set_xlabel("time [s]")
    axes.set_ylabel("mean rotor speed [rpm]")
    axes.legend(loc="best")
    return figure


def _actuation(evidence: Evidence) -> Figure:
    """RMS and total variation of the action over all seeds and trials: what tells controllers apart (C6)."""
    figure, panels = _canvas(1, 2, 2.6)
    measured = (("RMS of the action [1]", "action_rms"), ("total variation [1 per step]", "action_total_variation"))
    for axes, (label, name) in zip(panels, measured, strict=True):
        for place, behaviour in enumerate(BEHAVIOURS):
            judged = evidence.response(behaviour, "last", "printed").judgements
            _box(axes, np.concatenate([getattr(judgement, name) for judgement in judged]), place, COLOURS[behaviour])
        axes.set_ylabel(label)
        axes.set_ylim(bottom=0)
    return figure


def _settling_time(judged: Judgement, axis: str) -> np.ndarray:
    return judged.settling_time[axis]


def _overshoot(judged: Judgement, axis: str) -> np.ndarray:
    return 100 * judged.overshoot_raw[axis]


def _error(judged: Judgement, axis: str) -> np.ndarray:
    """Errors in mm or deg; the logarithmic axis begins at a hundredth of either."""
    error = judged.steady_state_error[axis]
    return np.maximum(np.degrees(error) if axis == "yaw" else 1e3 * error, 0.01)


_settling = functools.partial(_boxes, metric=_settling_time, label="settling time [s]")
_overshoots = functools.partial(_boxes, metric=_overshoot, label="overshoot [% of the step]")
_errors = functools.partial(_boxes, metric=_error, label="steady-state error [mm; deg]", logarithmic=True)
DRAWINGS: dict[str, Callable[[Evidence], Figure]] = {
    "reward": _reward,
    "settling": functools.partial(_settling, setting="printed"),
    "overshoot": functools.partial(_overshoots, setting="printed"),
    "error": functools.partial(_errors, setting="printed"),
    "settling-fair": functools.partial(_settling, setting="fair"),
    "overshoot-fair": functools.partial(_overshoots, setting="fair"),
    "error-fair": functools.partial(_errors, setting="fair"),
    "profile": _profile,
    "rotor-speed": _rotor_speed,
    "actuation": _actuation,
    "settling-averaged": functools.partial(_settling, weights="averaged", setting="fair"),
}
