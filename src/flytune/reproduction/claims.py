"""A verdict for each claim of the paper, R23 to R30 and H1 to H11.

Verdicts rest on the weights of the last update, which the paper would have flown. The averaged weights stand beside
them without a verdict.
"""

import tomllib
from collections.abc import Callable, Collection
from importlib import resources
from typing import Any

from flytune.config import document
from flytune.config.nested import leaves
from flytune.reproduction import learning, measures
from flytune.reproduction.evidence import Evidence, Weights
from flytune.reproduction.measures import ClaimMeasures
from flytune.reproduction.study import BEHAVIOURS
from flytune.reproduction.verdict import JudgedClaim, Measure, decide
from flytune.task.files import load_task
from flytune.training.trainer import find_trainer

MEASURES: dict[str, Callable[[Evidence, Weights], ClaimMeasures]] = {
    "R23-damping": measures.damping,
    "R23-error": measures.steady_state,
    "R24": measures.order,
    "R25": measures.overshoot,
    "R26": measures.all_settle,
    "R27-variance": learning.variance,
    "R27-survival": learning.survival,
    "R28": learning.efficiency,
    "R29-actuation": measures.actuation,
    "R29-settling": measures.inspection_first,
    "R30": measures.robustness,
}
OF_TRAINING = {"R27-variance", "R27-survival", "R28"}  # nothing is flown, so there is no row for averaged weights


def judge_claims(evidence: Evidence, items: Collection[str] | None = None) -> list[JudgedClaim]:
    """Every claim with its verdict, in the order of the paper's items; all of them where `items` is None."""
    texts = tomllib.loads((resources.files("flytune.reproduction") / "claims.toml").read_text(encoding="utf-8"))
    return [
        _heuristic(evidence, item, text) if "parameters" in text else _claim(evidence, item, text)
        for item, text in texts.items()
        if items is None or item in items
    ]


def _claim(evidence: Evidence, item: str, text: dict[str, Any]) -> JudgedClaim:
    last = MEASURES[item](evidence, "last")
    verdict, reason = decide(last.printed, last.reading), ""
    if "untestable" in text:
        verdict, reason = "cannot be tested as printed", text["untestable"]
    elif short := _too_short(evidence):
        verdict, reason = "cannot be tested with this study", short
    elif verdict == "cannot be tested with this study":
        missing = (measure.missing for measure in last.reading or last.printed)
        reason = next((each for each in missing if each), "nothing was measured")
    return JudgedClaim(
        item=item,
        claim=text["claim"],
        verdict=verdict,
        reading=text["reading"],
        why=f"{reason[0].upper()}{reason[1:]}. {text['why']}" if reason else text["why"],
        measures=last.all(),
        averaged=[] if item in OF_TRAINING else MEASURES[item](evidence, "averaged").all(),
    )


def _too_short(evidence: Evidence) -> str:
    """Why no claim can be tested on trainings that were shorter than those of the task; empty where they were not."""
    study = evidence.study
    settings = find_trainer(study.trainer).settings
    for behaviour in BEHAVIOURS:
        trained, meant = settings(study.task(behaviour)), settings(load_task(study.preset(behaviour)))
        if trained.updates < meant.updates:
            steps, wanted = (each.updates * each.steps_per_update for each in (trained, meant))
            return f"the trainings ended after {steps:,} environment steps of {wanted:,}"
    return ""


def _heuristic(evidence: Evidence, item: str, text: dict[str, Any]) -> JudgedClaim:
    """What three presets can say of one parameter: its values, and how many others changed with it."""
    values_of = {behaviour: dict(leaves(document.plain(task))) for behaviour, task in evidence.tasks.items()}
    rows = []
    for parameter in text["parameters"]:
        values = ", ".join(f"{behaviour} {values_of[behaviour].get(parameter, 'none')}" for behaviour in BEHAVIOURS)
        rows.append(Measure(what=f"{parameter}: {values}", value=None))
    for behaviour in ("acrobatic", "inspection"):
        ours, baseline = values_of[behaviour], values_of["baseline"]
        changed = [
            path
            for path in ours.keys() | baseline.keys()
            if path.startswith(("reward.", "termination.")) and ours.get(path) != baseline.get(path)
        ]
        rows.append(Measure(what=f"parameters in which {behaviour} differs from baseline", value=float(len(changed))))
    return JudgedClaim(
        item=item,
        claim=text["claim"],
        verdict="cannot be tested as printed",
        reading="One parameter at a time would be needed.",
        why=f"Three presets that differ in many parameters at once cannot show what one of them does. {text['why']}",
        measures=rows,
    )
