"""The report: one self-contained page on how one or several controllers fly, and how they were trained."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from flytune.errors import BadInput
from flytune.evaluation import metrics
from flytune.evaluation.comparison import Comparison, compare
from flytune.evaluation.comparison_table import (
    comparison_table,
    conditions,
    controller_cell,
    differences_table,
    sentences,
)
from flytune.evaluation.evaluate import Evaluation
from flytune.evaluation.path_table import path_tables
from flytune.evaluation.table import response_table
from flytune.report import comparison_plots, envelope, plots, words
from flytune.report.learning import ends_that_never_came, learning
from flytune.report.page import write_page
from flytune.report.path_plots import tracking
from flytune.report.style import listed

SAME_PLACE = 1e-4  # m; another simulator may round the start, which is metres away


def write_report(path: Path, evaluations: Sequence[Evaluation], comparison: Comparison | None = None) -> None:
    """Write the report of one or several controllers as one HTML file, whole or not at all.

    Several controllers are compared first, then each has its section. `comparison` is that of their judgements, in the
    same order. Where None, controllers that flew the same trials are compared with the first one; for others, the page
    says why there are no paired differences.

    Raises:
        BadInput: no controller, a comparison of other controllers or other trials, or the file cannot be written.
    """
    if not evaluations:
        raise BadInput(
            "report: no controller. Allowed: one or more. Name a run directory, a policy file or a controller."
        )
    different = ""  # why the controllers cannot be compared trial by trial
    if comparison:
        _check_same_trials(evaluations, comparison)
    elif len(evaluations) > 1:
        try:
            comparison = compare([evaluation.judgement for evaluation in evaluations])
            _check_same_trials(evaluations, comparison)
        except BadInput as reason:
            comparison = None
            different = f"There are no paired differences, since the controllers flew different trials ({reason})"
    names = comparison.names if comparison else [evaluation.name for evaluation in evaluations]
    evaluations = [
        dataclasses.replace(one, name=name, judgement=dataclasses.replace(one.judgement, name=name))
        for name, one in zip(names, evaluations, strict=True)
    ]
    write_page(
        path,
        "report.html",
        controllers=[_controller(evaluation) for evaluation in evaluations],
        several=_comparison(evaluations, comparison, different) if len(evaluations) > 1 else None,
        position_band=metrics.POSITION_BAND,
        yaw_band=np.degrees(metrics.YAW_BAND),
    )


def _check_same_trials(evaluations: Sequence[Evaluation], comparison: Comparison) -> None:
    """Refuse controllers that are not those of the comparison, or whose trials start elsewhere."""
    number = len(comparison.judgements)
    if len(evaluations) != number:
        raise BadInput(
            f"compare: {len(evaluations)} controllers are not allowed. Allowed: {number}, one per judgement, in order."
        )
    first, *others = (one.flights.start_error for one in evaluations)
    for name, start in zip(comparison.names[1:], others, strict=True):
        if not np.allclose(start, first, rtol=0, atol=SAME_PLACE, equal_nan=True):
            raise BadInput(
                f"starts: {name} starts elsewhere, seen from its target, than {comparison.names[0]}. "
                "Allowed: the same for every controller. Fly all of them with one --task."
            )


def _controller(evaluation: Evaluation) -> dict[str, Any]:
    """What the section of one controller shows."""
    flights, judgement = evaluation.flights, evaluation.judgement
    return {
        "name": evaluation.name,
        "judgement": judgement,
        "summary": words.summary(judgement),
        "table": response_table(judgement.to_dict()),
        "paths": path_tables([judgement.to_dict()]),
        "tracking": tracking(flights, judgement) if judgement.tracking else None,
        "facts": words.facts(judgement, flights.speed_bound),
        "response": plots.response(flights, judgement, evaluation.task),
        "motion": plots.motion(flights, judgement),
        "spread": plots.spread(judgement),
        "margins": envelope.margins(flights, judgement),
        "space": envelope.flights_3d(flights),
        "learning": learning(evaluation.metrics),
        "never": listed(ends_that_never_came(evaluation.metrics)),
        "task": words.task_lines(evaluation.task),
        "about": evaluation.about,
    }


def _comparison(evaluations: Sequence[Evaluation], comparison: Comparison | None, different: str) -> dict[str, Any]:
    """The comparison on the page; paired differences only for controllers that flew the same trials."""
    judgements = [evaluation.judgement for evaluation in evaluations]
    shown = {
        "table": comparison_table(judgements),
        "paths": path_tables([judgement.to_dict() for judgement in judgements]),
        "share": plots.settled_share(judgements),
        "tasks": words.task_differences(evaluations),
    }
    if comparison is None:
        unknown = ("conditions", "sentences", "reference", "responses", "boxes", "differences")
        return {**shown, "paired": different, **dict.fromkeys(unknown)}
    return {
        **shown,
        "conditions": conditions(comparison),
        "sentences": sentences(comparison),
        "reference": controller_cell(comparison.reference + 1, comparison.names[comparison.reference]),
        "paired": comparison_plots.paired(comparison),
        "responses": comparison_plots.responses([one.flights for one in evaluations], comparison),
        "boxes": comparison_plots.boxes(comparison),
        "differences": differences_table(comparison),
    }
