"""The paper's figures (R21) for paper: matplotlib, as SVG."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from flytune.evaluation.judge import Judgement
from flytune.evaluation.metrics import POSITION_BAND, YAW_BAND
from flytune.evaluation.table import AXES
from flytune.report.plots import UNITS, course
from flytune.reproduction.curves import column
from flytune.reproduction.evidence import SHOWN, Evidence
from flytune.reproduction.study import ROLES

COLOURS = dict(zip(ROLES, ("#0b5fa5", "#d1690e", "#12805c"), strict=True))
STYLE: dict[Any, Any] = {
    "font.size": 8,
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
METRICS: dict[str, tuple[str, Callable[[Judgement, str], np.ndarray]]] = {
    "settling": ("settling time [s]", lambda judged, axis: judged.settling_time[axis]),
    "overshoot": ("overshoot [% of the step]", lambda judged, axis: 100 * judged.overshoot_raw[axis]),
    "error": ("steady-state error [mm; deg]", lambda judged, axis: _readable(judged.steady_state_error[axis], axis)),
}


def write_figures(folder: Path, evidence: Evidence) -> list[Path]:
    """Write every figure of the paper as SVG, and give their paths.

    Last weights throughout, as the paper would have them; starts and durations as printed.
    """
    folder.mkdir(parents=True, exist_ok=True)
    figures = {
        "reward": _reward,
        **{name: lambda evidence, name=name: _boxes(evidence, *METRICS[name]) for name in METRICS},
        "profile": _profile,
        "rotor-speed": _rotor_speed,
        "actuation": _actuation,
    }
    paths = []
    with mpl.rc_context(STYLE):
        for name, draw in figures.items():
            path = folder / f"{name}.svg"
            draw(evidence).savefig(path, metadata={"Date": None}, bbox_inches="tight")
            paths.append(path)
    return paths


def _canvas(
    rows: int, columns: int, width: float, height: float, share_time: bool = False
) -> tuple[Figure, Sequence[Axes]]:
    figure = Figure(figsize=(width, height), layout="constrained")
    return figure, list(np.ravel(figure.subplots(rows, columns, squeeze=False, sharex=share_time)))


def _readable(values: np.ndarray, axis: str) -> np.ndarray:
    """Errors in mm or deg; a logarithmic axis begins at a hundredth of either."""
    return np.maximum(np.degrees(values) if axis == "yaw" else 1e3 * values, 0.01)


def _reward(evidence: Evidence) -> Figure:
    """Episode reward over environment steps, mean over seeds with the band from the least to the greatest."""
    figure, (axes,) = _canvas(1, 1, 4.6, 2.8)
    for role in ROLES:
        curves = evidence.curves[role]
        length = min(map(len, curves))
        steps = column(curves[0], "steps")[:length] / 1e6
        rewards = np.array([column(rows, "episode_reward")[:length] for rows in curves])
        known = np.isfinite(rewards).any(axis=0)
        mean = np.nanmean(rewards[:, known], axis=0)
        axes.plot(steps[known], mean, color=COLOURS[role], label=role)
        low, high = np.nanmin(rewards[:, known], axis=0), np.nanmax(rewards[:, known], axis=0)
        axes.fill_between(steps[known], low, high, color=COLOURS[role], alpha=0.18, linewidth=0)
    axes.set_xlabel("environment steps [millions]")
    axes.set_ylabel("episode reward")
    axes.legend(loc="lower right")
    return figure


def _boxes(evidence: Evidence, label: str, of: Callable[[Judgement, str], np.ndarray]) -> Figure:
    """Boxes per axis and behaviour over all seeds and trials; beneath each, how many trials it shows."""
    figure, panels = _canvas(1, len(AXES), 7.2, 2.6)
    for axes, axis in zip(panels, AXES, strict=True):
        for place, role in enumerate(ROLES):
            judged = evidence.seat(role, "last", "printed").judgements
            values = np.concatenate([of(judgement, axis) for judgement in judged])
            known = values[np.isfinite(values)]
            axes.boxplot(
                [known],
                positions=[place],
                widths=0.6,
                showfliers=False,
                patch_artist=True,
                boxprops={"facecolor": COLOURS[role], "alpha": 0.35, "linewidth": 0.6},
                medianprops={"color": COLOURS[role], "linewidth": 1.4},
                whiskerprops={"linewidth": 0.6},
                capprops={"linewidth": 0.6},
            )
            share = f"{known.size / values.size:.0%}"
            axes.annotate(share, (place, 1.0), xycoords=("data", "axes fraction"), ha="center", va="bottom", fontsize=6)
        axes.set_xticks(range(len(ROLES)), [role[:5] + "." for role in ROLES])
        axes.set_title(axis, pad=12)
        if label.startswith("steady-state"):  # from millimetres to metres
            axes.set_yscale("log")
        else:
            axes.set_ylim(bottom=0)
    panels[0].set_ylabel(label)
    return figure


def _profile(evidence: Evidence) -> Figure:
    """x, y, z and yaw against time for the first five tests, three behaviours overlaid, first seed."""
    figure, panels = _canvas(2, 2, 7.2, 4.4, share_time=True)
    for axes, axis in zip(panels, AXES, strict=True):
        target = 0.0
        for role in ROLES:
            flights = evidence.seat(role, "last", "printed").flights
            values, target, _ = course(flights, axis)
            lines = axes.plot(flights.time, values[:SHOWN].T, color=COLOURS[role], linewidth=0.8)
            lines[0].set_label(role)
        band = POSITION_BAND if axis != "yaw" else np.degrees(YAW_BAND)
        axes.axhspan(target - band, target + band, color="#12805c", alpha=0.15, linewidth=0)
        axes.axhline(target, color="#1f2933", linewidth=0.6, linestyle="--")
        axes.set_ylabel(f"{axis} [{UNITS[axis]}]")
    panels[0].legend(loc="best")
    for axes in panels[2:]:
        axes.set_xlabel("time [s]")
    return figure


def _rotor_speed(evidence: Evidence) -> Figure:
    """Rotor speed, mean over four motors and five tests, against time: what the paper draws (C6)."""
    figure, (axes,) = _canvas(1, 1, 4.6, 2.6)
    for role in ROLES:
        flights = evidence.seat(role, "last", "printed").flights
        speed = flights.rotor_speed_rpm[:SHOWN, 1:].mean(axis=(0, 2))
        axes.plot(flights.time[1:], speed, color=COLOURS[role], linewidth=0.8, label=role)
    axes.set_xlabel("time [s]")
    axes.set_ylabel("mean rotor speed [rpm]")
    axes.legend(loc="best")
    return figure


def _actuation(evidence: Evidence) -> Figure:
    """RMS and total variation of the action over all seeds and trials: what tells controllers apart (C6)."""
    figure, panels = _canvas(1, 2, 5.2, 2.6)
    measured = (("RMS of the action [1]", "action_rms"), ("total variation [1 per step]", "action_total_variation"))
    for axes, (label, name) in zip(panels, measured, strict=True):
        for place, role in enumerate(ROLES):
            judged = evidence.seat(role, "last", "printed").judgements
            values = np.concatenate([getattr(judgement, name) for judgement in judged])
            axes.boxplot([values[np.isfinite(values)]], positions=[place], widths=0.6, showfliers=False,
                         patch_artist=True, boxprops={"facecolor": COLOURS[role], "alpha": 0.35, "linewidth": 0.6},
                         medianprops={"color": COLOURS[role], "linewidth": 1.4})  # fmt: skip
        axes.set_xticks(range(len(ROLES)), [role[:5] + "." for role in ROLES])
        axes.set_ylabel(label)
        axes.set_ylim(bottom=0)
    return figure
