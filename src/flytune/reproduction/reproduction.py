"""The paper, run again from one call: train what is missing, fly, judge, draw, write."""

import dataclasses
import platform
import time
from collections.abc import Callable
from importlib import metadata
from pathlib import Path
from typing import Any

from flytune.config.files import held, make_folder, write_json, write_text
from flytune.reproduction.claims import judge_claims
from flytune.reproduction.evidence import Evidence, gather_evidence
from flytune.reproduction.figures import draw_figures
from flytune.reproduction.inconsistencies import Inconsistency, find_inconsistencies
from flytune.reproduction.page import html, markdown, summary, verdict_table
from flytune.reproduction.study import Study, Training, open_study
from flytune.reproduction.trainings import train_all
from flytune.reproduction.verdict import JudgedClaim
from flytune.training.loop import Progress
from flytune.training.threads import free_cores


@dataclasses.dataclass(frozen=True, kw_only=True)
class Reproduction:
    """The verdicts on the paper's claims, and the files that hold them."""

    study: Study
    claims: list[JudgedClaim]
    inconsistencies: list[Inconsistency]
    files: list[Path]  # what was written
    seconds: float  # of this call; less where trainings were done before

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
            "verdicts": [claim.to_dict() for claim in self.claims],
            "inconsistencies": [dataclasses.asdict(inconsistency) for inconsistency in self.inconsistencies],
        }

    def table(self) -> str:
        """The verdicts and their summary, for a terminal."""
        return f"{verdict_table(self.claims, ('verdict', 'claim'))}\n\n{summary(self.claims)}"

    def __repr__(self) -> str:
        return f"Reproduction({self.study.folder}: {summary(self.claims)})"


def reproduce(
    out: Path | str | None = None,
    *,
    trainer: str = "ppo",
    seeds: int = 5,
    steps: int | None = None,
    refined: bool = False,
    workers: int | None = None,
    on_progress: Callable[[Training, Progress], None] = lambda training, progress: None,
    on_message: Callable[[str], None] = lambda line: None,
) -> Reproduction:
    """The paper, run again: three behaviours trained, flown and drawn, and a verdict for each claim.

    Writes `report.html`, `verdicts.json`, `verdicts.md`, `figures/*.svg` and the runs into `out`. Trainings that an
    earlier call left there are kept, and interrupted ones continue from their checkpoint.

    Args:
        out: the folder; `runs/reproduction-TRAINER` where None (`...-refined` for the refined presets).
        trainer: `ppo`, which the paper uses, or `apg`.
        seeds: trainings of each behaviour, 1 to 100.
        steps: environment steps of each training; the task's own where None.
        refined: the refined presets in place of the printed ones.
        workers: trainings side by side, each in a process of its own; one per free core where None.
        on_progress: called from several threads, a few times a second per training.
        on_message: called with a line for the user.

    Raises:
        BadInput: an argument that cannot be used, or a folder that holds something else.
        Diverged: the numbers of a training stopped being finite.
        Interrupted: Ctrl-C; every training under way saved a checkpoint.
    """
    started = time.monotonic()
    if out is None:
        out = Path("runs") / f"reproduction-{trainer}{'-refined' if refined else ''}"
    study = Study(folder=Path(out), trainer=trainer, seeds=seeds, steps=steps, refined=refined)
    open_study(study)
    with held(study.folder):
        train_all(study, on_progress=on_progress, on_message=on_message, workers=workers)
        return _write(gather_evidence(study, on_message), started)


def _write(evidence: Evidence, started: float) -> Reproduction:
    """Judge and draw the evidence, and write everything into the study's folder."""
    folder = evidence.study.folder
    claims, inconsistencies = judge_claims(evidence), find_inconsistencies(evidence)
    figures = draw_figures(evidence)
    make_folder(folder / "figures")
    files = {folder / "figures" / f"{name}.svg": svg for name, svg in figures.items()}
    files[folder / "report.html"] = html(evidence, claims, inconsistencies, figures)
    files[folder / "verdicts.md"] = markdown(claims, inconsistencies)
    for path, text in files.items():
        write_text(path, text)
    record = folder / "verdicts.json"
    result = Reproduction(
        study=evidence.study,
        claims=claims,
        inconsistencies=inconsistencies,
        files=[*files, record],
        seconds=time.monotonic() - started,
    )
    write_json(record, result.to_dict())
    return result
