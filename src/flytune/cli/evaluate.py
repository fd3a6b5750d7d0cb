"""`flytune evaluate`, `compare` and `report`: controllers fly many trials, and their step response is judged."""

import json
import os
import sys
from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter

from flytune.cli.options import (
    FLIGHT_DEFAULTS,
    AsJson,
    Controller,
    Controllers,
    FlightOptions,
    Folder,
    check_flights,
    check_folder,
)
from flytune.config.files import check_file, check_suffix, make_folder, write_json
from flytune.errors import BadInput

FlightsFile = Annotated[Path | None, Parameter(name="--flights", metavar="FILE.npz")]


def evaluate(
    controller: Controller,
    /,
    *,
    options: FlightOptions = FLIGHT_DEFAULTS,
    as_json: AsJson = False,
    out: Annotated[Folder, Parameter(help="where to write evaluation.json (default: the run directory)")] = None,
    flights: Annotated[FlightsFile, Parameter(help="write the trajectories, with named columns")] = None,
) -> None:
    """Fly many trials and judge the step response."""
    from flytune.evaluation.evaluate import EVALUATION, evaluate, write_evaluation

    check_folder(out, controller)
    if flights is not None:
        check_flights(flights)
    evaluation = evaluate(controller, **options.settings())
    judgement = evaluation.judgement
    if flights is not None:
        evaluation.flights.save(flights)
    print(json.dumps(judgement.to_dict()) if as_json else judgement.table(), flush=True)
    if out is not None and not (out / "run.json").exists():
        write_evaluation(out, judgement)
    elif os.path.isdir(controller):
        try:
            file = write_evaluation(Path(controller), judgement, evaluation.task)
        except BadInput as error:  # it may be the run of somebody else; the result itself has been printed
            print(f"not kept: {error}", file=sys.stderr)
        else:
            if file.name != EVALUATION:
                print(f"kept as {file}, because {EVALUATION} is of the run's own task", file=sys.stderr)


def compare(
    controllers: Controllers,
    /,
    *,
    options: FlightOptions = FLIGHT_DEFAULTS,
    as_json: AsJson = False,
    out: Annotated[
        Folder, Parameter(help="where to write comparison.html and comparison.json (default: nowhere)")
    ] = None,
    flights: Annotated[FlightsFile, Parameter(help="write the trajectories, as FILE-1.npz, FILE-2.npz, ...")] = None,
) -> None:
    """Fly two or more controllers from the same initial conditions, and judge them side by side."""
    from flytune.evaluation.comparison import compare
    from flytune.evaluation.evaluate import evaluate_all
    from flytune.report.page import page_mark
    from flytune.report.report import write_report

    first, *others = controllers
    if not others:
        raise BadInput(f"CONTROLLER: {first} alone cannot be compared. Allowed: two or more. Name another.")
    check_folder(out)
    if out is not None and out.exists():
        check_file(out / "comparison.json", mark=b'"differences": [', kind="a comparison")
        check_file(out / "comparison.html", mark=page_mark("report.html"), kind="a page of controllers")
    if flights is not None:  # before it gets numbers, so that the message has the name that was typed
        check_suffix(flights, "flights", "a file of flights", [".npz"])
    numbered = (
        []
        if flights is None
        else [flights.with_stem(f"{flights.stem}-{number}") for number in range(1, len(controllers) + 1)]
    )
    check_flights(*numbered)
    evaluations = evaluate_all(controllers, **_one_task(controllers, options))
    comparison = compare([evaluation.judgement for evaluation in evaluations])
    for file, evaluation in zip(numbered, evaluations, strict=False):
        evaluation.flights.save(file)
    print(json.dumps(comparison.to_dict()) if as_json else comparison.table(), flush=True)
    if out is not None:
        make_folder(out)
        write_json(out / "comparison.json", comparison.to_dict())
        write_report(out / "comparison.html", evaluations, comparison)


def report(
    controllers: Controllers,
    /,
    *,
    options: FlightOptions = FLIGHT_DEFAULTS,
    out: Annotated[Path, Parameter(metavar="FILE", help="the page, or a folder for report.html")] = Path("report.html"),
) -> None:
    """Print the tables of one or more controllers, and write one self-contained HTML page."""
    from flytune.evaluation.evaluate import evaluate_all
    from flytune.report.page import page_mark
    from flytune.report.report import write_report

    if os.path.isdir(out):
        out = out / "report.html"
    check_file(out, mark=page_mark("report.html"), kind="a page of controllers", suffixes=[".html", ".htm"])
    evaluations = evaluate_all(controllers, **_one_task(controllers, options))
    print("\n\n".join(evaluation.judgement.table() for evaluation in evaluations), end="\n\n")
    write_report(out, evaluations)
    print(out)


def _one_task(controllers: tuple[str, ...], options: FlightOptions) -> dict[str, Any]:
    """The settings of flights on one task, which standard error names where the user did not."""
    from flytune.evaluation.evaluate import shared_task

    settings = options.settings()
    task, origin = shared_task(controllers, options.task)
    if origin is not None and len(controllers) > 1:
        source = f"that of {origin}" if origin else "since no controller says what it was trained for"
        print(f"every controller flies the task {task.name}, {source}; --task names another", file=sys.stderr)
    return settings | {"task": task}
