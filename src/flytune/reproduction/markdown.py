"""Verdicts and their numbers as Markdown, for a paper's appendix or a repository's page."""

from collections.abc import Iterable, Sequence

from flytune.reproduction.inconsistencies import Point
from flytune.reproduction.verdict import Measure, Verdict

MARKS = {True: "yes", False: "no", None: ""}


def markdown(verdicts: Sequence[Verdict], points: Sequence[Point]) -> str:
    """Everything measured: the table of verdicts, each claim with its numbers, and where the paper cannot hold."""
    parts = [
        "## Verdicts",
        verdict_table(verdicts),
        "## Every claim",
        *(_claim(verdict) for verdict in verdicts),
        "## Where it cannot hold as printed",
        *(f"### {point.item}\n\n{point.text}\n\n{_measures(point.measures)}".rstrip() for point in points),
    ]
    return "\n\n".join(parts) + "\n"


def verdict_table(verdicts: Sequence[Verdict]) -> str:
    """Item, claim, verdict and reading of every claim."""
    rows = [(verdict.item, verdict.claim, f"**{verdict.word}**", verdict.reading) for verdict in verdicts]
    return _table(("item", "claim", "verdict", "reading"), rows)


def _claim(verdict: Verdict) -> str:
    lines = [f"### {verdict.item}: {verdict.word}", f"{verdict.claim} {verdict.why}", _measures(verdict.measures)]
    if verdict.average:
        lines += ["Averaged weights, without a verdict:", _measures(verdict.average)]
    return "\n\n".join(line for line in lines if line)


def _measures(measures: Sequence[Measure]) -> str:
    if not measures:
        return ""
    rows = [(measure.what, measure.text(), MARKS[measure.agrees]) for measure in measures]
    return _table(("measured", "value [95 % interval]", "agrees"), rows)


def _table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join(f"| {' | '.join(cell.replace('|', '/') for cell in line)} |" for line in lines)
