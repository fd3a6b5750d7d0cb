"""What a reproduction shows: the verdicts in a terminal, as Markdown and as a page, from the same tables."""

import dataclasses
import itertools
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any, get_args

from flytune.evaluation.comparison_table import comparison_table
from flytune.report import page
from flytune.reproduction.evidence import SEED, SETTINGS, TRIALS, WEIGHTS_FILES, Evidence
from flytune.reproduction.figures import FIGURES
from flytune.reproduction.inconsistencies import Inconsistency
from flytune.reproduction.study import BEHAVIOURS
from flytune.reproduction.verdict import JudgedClaim, Measure, Verdict
from flytune.tables import Cell, Table

TONES: dict[Verdict, str] = dict(zip(get_args(Verdict), ("good", "fair", "bad", "unknown", "unknown"), strict=True))
PLURALS = (
    "hold", "hold under a reading", "do not hold", "cannot be tested as printed", "cannot be tested with this study"
)  # fmt: skip
AGREES = {True: "yes", False: "no", None: ""}


def summary(claims: Sequence[JudgedClaim]) -> str:
    """How many claims there are of each verdict, in one sentence."""
    counts = Counter(claim.verdict for claim in claims)
    plurals = zip(get_args(Verdict), PLURALS, strict=True)
    parts = [
        f"{counts[verdict]} {verdict if counts[verdict] == 1 else plural}"
        for verdict, plural in plurals
        if counts[verdict] or verdict != "cannot be tested with this study"
    ]
    return f"Of {len(claims)} claims, {', '.join(parts[:-1])} and {parts[-1]}."


def verdict_table(claims: Sequence[JudgedClaim], columns: Sequence[str] = ("verdict", "claim", "reading")) -> Table:
    """The item of every claim beside its verdict, its text and its reading."""

    def cell(claim: JudgedClaim, column: str) -> str | Cell:
        text = getattr(claim, column)
        return Cell(text=text, tone=f"verdict {TONES[text]}") if column == "verdict" else text

    rows = [(claim.item, *(cell(claim, name) for name in columns)) for claim in claims]
    return Table.plain(("item", *columns), rows, style="stacked")


def measure_table(measures: Sequence[Measure], title: str = "measured") -> Table:
    """The numbers behind a verdict, and whether each agrees with the claim."""
    rows = [(measure.what, measure.missing or measure.text(), AGREES[measure.agrees]) for measure in measures]
    return Table.plain((title, "value [95 % interval]", "agrees"), rows, style="stacked")


def markdown(claims: Sequence[JudgedClaim], inconsistencies: Sequence[Inconsistency]) -> str:
    """Everything that was measured: the verdicts, each claim with its numbers, and the inconsistencies."""
    parts = ["## Verdicts", summary(claims), verdict_table(claims).markdown(), "## Every claim"]
    for claim in claims:
        parts += [f"### {claim.item}: {claim.verdict}", f"{claim.claim} {claim.why}"]
        parts.append(measure_table(claim.measures).markdown())
        if claim.averaged:
            parts += ["Averaged weights, without a verdict:", measure_table(claim.averaged).markdown()]
    parts.append("## Where the paper is inconsistent as printed")
    for each in inconsistencies:
        parts += [f"### {each.item}", each.text]
        parts += [measure_table(each.measures).markdown()] if each.measures else []
    return "\n\n".join(parts) + "\n"


def html(
    evidence: Evidence,
    claims: Sequence[JudgedClaim],
    inconsistencies: Sequence[Inconsistency],
    figures: Mapping[str, str],
) -> str:
    """The page of a reproduction, which carries its figures (SVG by name)."""
    flown = [
        dataclasses.replace(judgement, name=f"{behaviour} seed {seed}, {weights}")
        for behaviour in BEHAVIOURS
        for weights in WEIGHTS_FILES
        for seed, judgement in enumerate(evidence.response(behaviour, weights).judgements)
    ]
    values: dict[str, Any] = {
        "summary": summary(claims),
        "about": _about(evidence),
        "verdicts": verdict_table(claims),
        "tones": TONES,
        "drawings": {
            section: [(spec, figures[spec.name]) for spec in specs]
            for section, specs in itertools.groupby(FIGURES, key=lambda spec: spec.section)
        },
        "claims": [
            (
                claim,
                measure_table(claim.measures, "last weights"),
                measure_table(claim.averaged, "averaged weights, without a verdict"),
            )
            for claim in claims
        ],
        "inconsistencies": [(each, measure_table(each.measures)) for each in inconsistencies],
        "seeds": comparison_table(flown),
    }
    return page.render("reproduction.html", **values)


def _about(evidence: Evidence) -> str:
    """What was trained and how it was flown."""
    study = evidence.study
    steps = "the task's own number of steps" if study.steps is None else f"{study.steps:,} steps"
    settings = "; ".join(setting.text for setting in SETTINGS)
    return (
        f"{', '.join(map(study.preset, BEHAVIOURS))}: {study.seeds} seeds of each, trainer {study.trainer}, {steps}. "
        f"Every policy flew {TRIALS} trials with seed {SEED} under {len(SETTINGS)} settings ({settings})."
    )
