"""What a reproduction shows: the verdicts as a page, as Markdown and in a terminal, from the same tables."""

import base64
from collections import Counter
from collections.abc import Mapping, Sequence
from html import escape
from typing import get_args

from flytune.report import page, tables
from flytune.reproduction.evidence import SEED, SETTINGS, TRIALS, WEIGHTS_FILES, Evidence
from flytune.reproduction.figures import FIGURES, FigureSpec
from flytune.reproduction.inconsistencies import Inconsistency
from flytune.reproduction.study import BEHAVIOURS
from flytune.reproduction.verdict import JudgedClaim, Measure, Verdict

MARKS = {True: "yes", False: "no", None: ""}
COLOURS: dict[str, str] = dict(zip(get_args(Verdict), ("holds", "reading", "fails", "untestable"), strict=True))
PLURAL: dict[Verdict, str] = {
    "holds": "hold",
    "holds under a reading": "hold under a reading",
    "does not hold": "do not hold",
    "cannot be tested as printed": "cannot be tested as printed",
}
Table = tuple[Sequence[str], Sequence[Sequence[str]]]


def summary(claims: Sequence[JudgedClaim]) -> str:
    """How many claims there are of each verdict, in one sentence."""
    counts = Counter(claim.verdict for claim in claims)
    parts = [f"{counts[verdict]} {verdict if counts[verdict] == 1 else PLURAL[verdict]}" for verdict in PLURAL]
    return f"Of {len(claims)} claims, {', '.join(parts[:-1])} and {parts[-1]}."


def verdict_table(claims: Sequence[JudgedClaim]) -> Table:
    """Item, claim, verdict and reading of every claim."""
    rows = [(claim.item, claim.claim, claim.verdict, claim.reading) for claim in claims]
    return ("item", "claim", "verdict", "reading"), rows


def measure_table(measures: Sequence[Measure], title: str = "measured") -> Table:
    """The numbers behind a verdict, and whether each agrees with the claim."""
    rows = [(measure.what, measure.text(), MARKS[measure.agrees]) for measure in measures]
    return (title, "value [95 % interval]", "agrees"), rows


def markdown(claims: Sequence[JudgedClaim], inconsistencies: Sequence[Inconsistency]) -> str:
    """Everything that was measured: the verdicts, each claim with its numbers, and the inconsistencies."""
    parts = ["## Verdicts", summary(claims), _markdown(verdict_table(claims)), "## Every claim"]
    for claim in claims:
        parts += [f"### {claim.item}: {claim.verdict}", f"{claim.claim} {claim.why}"]
        parts += [_markdown(measure_table(claim.measures))]
        if claim.averaged:
            parts += ["Averaged weights, without a verdict:", _markdown(measure_table(claim.averaged))]
    parts.append("## Where the paper is inconsistent as printed")
    for each in inconsistencies:
        parts += [f"### {each.item}", each.text, _markdown(measure_table(each.measures))]
    return "\n\n".join(part for part in parts if part) + "\n"


def html(
    evidence: Evidence,
    claims: Sequence[JudgedClaim],
    inconsistencies: Sequence[Inconsistency],
    figures: Mapping[str, str],
) -> str:
    """The page of a reproduction, with its figures (SVG by name) inside."""
    sections = {"Verdicts": _html(verdict_table(claims)) + f'<p class="quiet">{VERDICTS}</p>'}
    for spec in FIGURES:
        sections[spec.section] = sections.get(spec.section, "") + _figure(spec, figures[spec.name])
    sections["Every claim"] = "".join(map(_claim, claims))
    sections["Where the paper is inconsistent as printed"] = "".join(
        f"<h3>{each.item}</h3><p>{escape(each.text)}</p>{_html(measure_table(each.measures))}"
        for each in inconsistencies
    )
    sections["Every seed"] = tables.comparison_table(
        [
            ("s0", f"{behaviour} seed {seed}, {weights}", judgement)
            for behaviour in BEHAVIOURS
            for weights in WEIGHTS_FILES
            for seed, judgement in enumerate(evidence.evaluation(behaviour, weights).judgements)
        ]
    )
    links = "".join(f'<a href="#s{number}">{name}</a>' for number, name in enumerate(sections))
    body = "".join(
        f'<h2 id="s{number}">{name}</h2><div class="figures">{html}</div>'
        for number, (name, html) in enumerate(sections.items())
    )
    return page.page(
        "flytune: the paper, reproduced",
        f'<style>{STYLE}</style><h1>The paper, reproduced</h1><p class="lead">{summary(claims)}</p>'
        f'<p class="quiet">{escape(_about(evidence))}</p><nav>{links}</nav>{body}',
    )


def _about(evidence: Evidence) -> str:
    """What was trained and how it was flown."""
    study = evidence.study
    steps = "the task's own number of steps" if study.steps is None else f"{study.steps:,} steps"
    settings = "; ".join(setting.text for setting in SETTINGS)
    return (
        f"{', '.join(map(study.preset, BEHAVIOURS))}: {study.seeds} seeds of each, trainer {study.trainer}, {steps}. "
        f"Every policy flew {TRIALS} trials with seed {SEED} under {len(SETTINGS)} settings ({settings})."
    )


def _figure(spec: FigureSpec, svg: str) -> str:
    """The figure as an image that the page carries, so that the ids of two figures cannot meet."""
    data = base64.b64encode(svg.encode()).decode()
    return (
        f'<figure><h3>{escape(spec.title)}</h3><img src="data:image/svg+xml;base64,{data}" '
        f'alt="{escape(spec.title)}"><figcaption>{escape(spec.caption)}</figcaption></figure>'
    )


def _claim(claim: JudgedClaim) -> str:
    parts = [
        f"<h3>{escape(claim.item)}: {_coloured(claim.verdict)}</h3><p><strong>{escape(claim.claim)}</strong> "
        f"{escape(claim.why)} Reading: {escape(claim.reading)}</p>",
        _html(measure_table(claim.measures, "last weights")),
    ]
    if claim.averaged:
        parts.append(_html(measure_table(claim.averaged, "averaged weights, without a verdict")))
    return "".join(parts)


def _coloured(cell: str) -> str:
    return f'<span class="{COLOURS[cell]}">{escape(cell)}</span>' if cell in COLOURS else escape(cell)


def _html(table: Table) -> str:
    head, rows = table
    if not rows:
        return ""
    cells = "".join(f"<th>{escape(name)}</th>" for name in head)
    return (
        f'<div class="words">{tables.table(f"<tr>{cells}</tr>", [[_coloured(cell) for cell in row] for row in rows])}'
        "</div>"
    )


def _markdown(table: Table) -> str:
    head, rows = table
    if not rows:
        return ""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join(f"| {' | '.join(cell.replace('|', '/') for cell in line)} |" for line in lines)


VERDICTS = (
    "A claim holds where it holds in the strict sense of its words. It holds under a reading where it holds only once "
    "an undefined word is given the meaning in the last column. Readings and thresholds were fixed before anything was "
    "measured: a claim about trials needs the lower end of the 95 % interval over seeds and trials at 95 %. Verdicts "
    "rest on the weights of the last update."
)
STYLE = """
.figures { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(100%, 440px), 1fr)); gap: 0 32px; }
.figures > :not(figure) { grid-column: 1 / -1; }
figure img { width: 100%; max-width: 620px; height: auto; }
.holds, .reading, .fails, .untestable { padding: 1px 8px; border-radius: 9px; white-space: nowrap; font-weight: 600; }
.holds { background: #d5eedd; color: #0b5132; }
.reading { background: #fdf0c8; color: #6b4a00; }
.fails { background: #fbdcd8; color: #8a1c13; }
.untestable { background: #e4e7eb; color: #3e4c59; }
"""
