"""The whole reproduction: train what is missing, fly, judge, draw, write."""

import dataclasses
import platform
import time
from collections.abc import Callable
from importlib import metadata
from pathlib import Path
from typing import Any

from flytune.config.files import write_json, write_text
from flytune.reproduction.claims import claims
from flytune.reproduction.evidence import Evidence, gather
from flytune.reproduction.figures import write_figures
from flytune.reproduction.inconsistencies import Point, points
from flytune.reproduction.markdown import markdown
from flytune.reproduction.page import write_page
from flytune.reproduction.study import Member, Study, open_study
from flytune.reproduction.trainings import free_cores, train_all
from flytune.reproduction.verdict import Verdict
from flytune.training.loop import Progress


@dataclasses.dataclass(frozen=True, kw_only=True)
class Reproduction:
    """What became of the paper's claims."""

    study: Study
    verdicts: list[Verdict]
    points: list[Point]
    files: list[Path]  # what was written
    seconds: float  # this time; less where trainings were done before

    def to_dict(self) -> dict[str, Any]:
        """Plain values, for JSON."""
        return {
            **self.study.plan(),
            "seeds": self.study.seeds,
            "seconds": round(self.seconds, 1),
            "cores": free_cores(),
            "machine": platform.machine(),
            "python": platform.python_version(),
            "versions": {name: metadata.version(name) for name in ("flytune", "jax", "numpy")},
            "verdicts": [verdict.to_dict() for verdict in self.verdicts],
            "points": [dataclasses.asdict(point) for point in self.points],
        }

    def table(self) -> str:
        """Item, verdict and claim, for a terminal."""
        lines = [f"{verdict.item:<14} {verdict.word:<26} {verdict.claim}" for verdict in self.verdicts]
        return "\n".join(lines)


def reproduce(
    study: Study,
    *,
    on_progress: Callable[[Member, Progress], None] = lambda member, progress: None,
    tell: Callable[[str], None] = lambda line: None,
    workers: int | None = None,
) -> Reproduction:
    """Run the paper again and judge every claim; goes on from wherever the study's folder stands.

    Writes `report.html`, `verdicts.json`, `verdicts.md` and `figures/*.svg` into the folder, beside the runs.

    Raises:
        BadInput: the folder cannot be used.
        Diverged: the numbers of a training stopped being finite.
        Interrupted: Ctrl-C; every training kept a checkpoint.
    """
    started = time.monotonic()
    open_study(study)
    train_all(study, on_progress=on_progress, tell=tell, workers=workers)
    evidence = gather(study, tell)
    return _write(evidence, started)


def _write(evidence: Evidence, started: float) -> Reproduction:
    study = evidence.study
    verdicts, contradictions = claims(evidence), points(evidence)
    figures = write_figures(study.folder / "figures", evidence)
    report, record, words = (study.folder / name for name in ("report.html", "verdicts.json", "verdicts.md"))
    write_page(report, evidence, verdicts, contradictions)
    result = Reproduction(
        study=study,
        verdicts=verdicts,
        points=contradictions,
        files=[report, record, words, *figures],
        seconds=time.monotonic() - started,
    )
    write_text(words, markdown(verdicts, contradictions))
    write_json(record, result.to_dict())
    return result
