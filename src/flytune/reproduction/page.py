"""The page of a reproduction: verdicts, figures, tables, and how each number came to be."""

import math
from collections.abc import Sequence
from html import escape
from pathlib import Path

from flytune.config.files import check_file, write_text
from flytune.report import page, plots, tables
from flytune.reproduction import drawings
from flytune.reproduction.evidence import CONDITIONS, SEED, TRIALS, Evidence
from flytune.reproduction.inconsistencies import Point
from flytune.reproduction.study import ROLES
from flytune.reproduction.verdict import Measure, Verdict

LENGTH = dict.fromkeys("xyz", ("mm", 1000.0)) | {"yaw": ("deg", math.degrees(1))}


def write_page(path: Path, evidence: Evidence, verdicts: Sequence[Verdict], points: Sequence[Point]) -> None:
    """Write the page of a reproduction, whole or not at all.

    Raises:
        BadInput: the file cannot be written.
    """
    check_file(path)
    write_text(path, page.page("flytune: the paper, reproduced", _body(evidence, verdicts, points)))


def verdict_table(verdicts: Sequence[Verdict]) -> list[tuple[str, str, str, str]]:
    """Item, claim, verdict and reading of every claim, as texts."""
    return [(verdict.item, verdict.claim, verdict.word, verdict.reading) for verdict in verdicts]


def _body(evidence: Evidence, verdicts: Sequence[Verdict], points: Sequence[Point]) -> str:
    parts = {
        "Verdicts": _verdicts(verdicts),
        "Learning": page.drawing(drawings.reward(evidence), _CAPTIONS["reward"]),
        "Metrics, as printed": _boxes(evidence, "printed"),
        "Metrics, under fair conditions": _boxes(evidence, "fair"),
        "Performance profile": page.drawing(drawings.profile(evidence, "last", "printed"), _CAPTIONS["profile"]),
        "Motors": page.drawing(drawings.rotor_speed(evidence, "last", "printed"), _CAPTIONS["motors"]),
        "Every claim": "".join(map(_claim, verdicts)),
        "Where it cannot hold as printed": "".join(map(_point, points)),
        "Every seed": _seeds(evidence),
        "Averaged weights": page.drawing(
            plots.settled_share(
                [
                    (f"{role}, {flown}", evidence.seat(role, flown).judgements[0])
                    for role in ROLES
                    for flown in ("last", "average")
                ]
            ),
            _CAPTIONS["average"],
        ),
    }
    links = "".join(f'<a href="#s{number}">{name}</a>' for number, name in enumerate(parts))
    body = "".join(f'<h2 id="s{number}">{name}</h2>{html}' for number, (name, html) in enumerate(parts.items()))
    study = evidence.study
    steps = "the task's own steps" if study.steps is None else f"{study.steps:,} steps"
    conditions = "; ".join(condition.text for condition in CONDITIONS)
    lead = (
        f"{', '.join(study.preset(role) for role in ROLES)}: {study.seeds} seeds of each, trainer {study.trainer}, "
        f"{steps}. Every policy flew {TRIALS} trials with start and noise seed {SEED} under {len(CONDITIONS)} "
        f"conditions ({conditions})."
    )
    return f'<h1>The paper, reproduced</h1><p class="quiet">{escape(lead)}</p><nav>{links}</nav>{body}'


def _verdicts(verdicts: Sequence[Verdict]) -> str:
    head = "<tr><th>item</th><th>claim</th><th>verdict</th><th>reading</th></tr>"
    rows = [tuple(map(escape, row)) for row in verdict_table(verdicts)]
    return f'<div class="words">{tables.table(head, rows)}</div>{_CAPTIONS["verdicts"]}'


def _claim(verdict: Verdict) -> str:
    parts = [
        f"<h3>{escape(verdict.item)}: {escape(verdict.word)}</h3><p><strong>{escape(verdict.claim)}</strong> "
        f"{escape(verdict.why)} Reading: {escape(verdict.reading)}</p>",
        _measures(verdict.measures, "last weights"),
    ]
    if verdict.average:
        parts.append(_measures(verdict.average, "averaged weights, without a verdict"))
    return "".join(parts)


def _point(point: Point) -> str:
    return f"<h3>{point.item}</h3><p>{escape(point.text)}</p>{_measures(point.measures, 'measured')}"


def _measures(measures: Sequence[Measure], title: str) -> str:
    if not measures:
        return ""
    marks = {True: "yes", False: "no", None: ""}
    head = f"<tr><th>{escape(title)}</th><th>value [95 % interval]</th><th>agrees</th></tr>"
    rows = [(escape(m.what), escape(m.text()), marks[m.agrees]) for m in measures]
    return f'<div class="words">{tables.table(head, rows)}</div>'


def _boxes(evidence: Evidence, condition: str) -> str:
    settling = drawings.boxes(
        evidence, "last", condition, lambda axis: ("s", 1.0), lambda judged, axis: judged.settling_time[axis]
    )
    overshoot = drawings.boxes(
        evidence,
        "last",
        condition,
        lambda axis: ("% of the step", 100.0),
        lambda judged, axis: judged.overshoot_raw[axis],
    )
    error = drawings.boxes(
        evidence,
        "last",
        condition,
        LENGTH.__getitem__,
        lambda judged, axis: judged.steady_state_error[axis],
        logarithmic=True,
    )
    return (
        f"<h3>Settling time</h3>{page.drawing(settling, _CAPTIONS['settling'])}"
        f"<h3>Overshoot</h3>{page.drawing(overshoot, _CAPTIONS['overshoot'])}"
        f"<h3>Steady-state error</h3>{page.drawing(error, _CAPTIONS['error'])}"
    )


def _seeds(evidence: Evidence) -> str:
    judged = [
        ("s0", f"{role} seed {seed}, {flown}", judgement)
        for role in ROLES
        for flown in ("last", "average")
        for seed, judgement in enumerate(evidence.seat(role, flown).judgements)
    ]
    return tables.comparison_table(judged)


_CAPTIONS = {
    "verdicts": """
<p class="quiet">A claim holds where it holds in the strict sense of its words; it holds under a reading where it holds
only once an undefined word is given the meaning in the last column. Readings and thresholds were fixed before anything
was measured: a claim about trials needs the lower end of the 95&nbsp;% interval over seeds and trials at 95&nbsp;%.
Verdicts rest on the weights of the last update.</p>""",
    "reward": """
Mean over seeds, and the band from the worst to the best of them. The rewards of different behaviours are not on one
scale: inspection's terms add up to less.""",
    "settling": """
Trials that settle; under each box how many these are. A low box over a small number is no success.""",
    "overshoot": "Raw: also excursions that stay inside the settling band. Small steps have none.",
    "error": "Distance of the mean of the last two seconds from the target, on each axis; the axis is logarithmic.",
    "profile": "The first five tests of the first seed, the same starts and noise for each; green is the band.",
    "motors": """
Left, what the paper draws: every controller that hovers has the hover speed in the mean (C6). Right, what tells them
apart.""",
    "average": """
First seed of each behaviour, fair conditions: the last weights, which the verdicts rest on, beside the weights averaged
over updates.""",
}
