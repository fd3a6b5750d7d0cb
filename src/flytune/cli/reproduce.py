"""`flytune reproduce`."""

import json
from typing import Annotated

from cyclopts import Parameter

from flytune.cli.options import AsJson, EveryTaskTrainerName, Flag, Folder, Whole, check_folder_name


def reproduce(
    *,
    trainer: Annotated[EveryTaskTrainerName, Parameter(help="how to learn; the paper used ppo")] = "ppo",
    seeds: Annotated[Whole, Parameter(help="number of trainings of each behaviour")] = 5,
    steps: Annotated[
        Whole | None, Parameter(help="number of environment steps of each training (default: the task's own)")
    ] = None,
    refined: Annotated[Flag, Parameter(help="use the refined presets instead of the printed ones")] = False,
    out: Annotated[
        Folder,
        Parameter(
            help="folder of the runs, the figures, the verdicts and the page; a reproduction in it is continued "
            "(default: runs/reproduction-TRAINER)"
        ),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Run the paper again: three behaviours, every figure, and a verdict on each claim."""
    from flytune.reproduction.reproduction import reproduce
    from flytune.reproduction.study import BEHAVIOURS
    from flytune.reproduction.trainings import show_trainings

    check_folder_name(out)
    with show_trainings(seeds * len(BEHAVIOURS)) as (on_progress, on_message):
        result = reproduce(
            out, trainer=trainer, seeds=seeds, steps=steps, refined=refined,
            on_progress=on_progress, on_message=on_message,
        )  # fmt: skip
    print(json.dumps(result.to_dict()) if as_json else result.table(), flush=True)
    if not as_json:
        print(result.study.folder / "report.html")
