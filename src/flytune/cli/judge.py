"""`flytune judge`."""

import json
import sys
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from flytune.cli.completion import columns as quantities
from flytune.cli.options import AsJson, Assignments, Real
from flytune.errors import BadInput

Files = Annotated[
    tuple[Path, ...],
    Parameter(
        name="FILE",
        help="an .npz file that `evaluate --flights` wrote, an .npz file of your own, or logs as text (.csv), one "
        "flight in each",
    ),
]


def judge(
    files: Files,
    /,
    *,
    columns: Annotated[
        Assignments,
        Parameter(
            name="--columns",
            metavar="NAME=COLUMN",
            completer=quantities,
            help="the columns of a log: time=stamp[ms] x=pos_n[mm] z=-down yaw=0 ...; NAME is one of time, x, y, z, "
            "yaw, qx, qy, qz, qw, vx, vy, vz, target_x, target_y, target_z, target_yaw, trial (default: found by their "
            "names)",
        ),
    ] = (),
    target: Annotated[
        str | None,
        Parameter(
            metavar="X,Y,Z,YAW",
            allow_leading_hyphen=True,
            help="the target, in m and rad (default: the one in the file)",
        ),
    ] = None,
    start: Annotated[
        Real | None,
        Parameter(
            metavar="S",
            help="where the step begins, in seconds after the first row (default: where the target in the file "
            "changes, else the first row)",
        ),
    ] = None,
    gap: Annotated[
        Real, Parameter(metavar="S", help="longest time without a sample that is interpolated, in seconds")
    ] = 0.25,
    as_json: AsJson = False,
) -> None:
    """Judge the step response of flights that were flown before, here or anywhere else."""
    from flytune.evaluation.judge import judge
    from flytune.evaluation.load_flights import load_flights

    told: list[str] = []  # printed once the files can be used: what is refused is one line alone
    flights = load_flights(
        *files,
        columns=_columns(columns),
        target=None if target is None else _target(target),
        start=start,
        longest_gap=gap,
        on_message=told.append,
    )
    for line in told:
        print(line, file=sys.stderr, flush=True)
    judgement = judge(flights)
    print(json.dumps(judgement.to_dict()) if as_json else judgement.table())


def _columns(texts: tuple[str, ...]) -> dict[str, str]:
    """Quantity and column of each NAME=COLUMN."""
    for text in texts:
        if "=" not in text:
            raise BadInput(f"columns: {text!r} is not allowed. Allowed: NAME=COLUMN, for instance x=pos_x.")
    return {name.strip(): column for name, _, column in (text.partition("=") for text in texts)}


def _target(text: str) -> list[float]:
    """The numbers of a text such as 0,0,1,0 or "[0, 0, 1, 0]"."""
    try:
        numbers = [float(part) for part in text.strip("[]() ").replace(",", " ").split()]
    except ValueError:
        numbers = []
    if len(numbers) != 4:
        raise BadInput(
            f"target: {text!r} is not allowed. Allowed: four numbers x,y,z,yaw in m and rad, with commas between them: "
            "--target 0,0,1,0."
        )
    return numbers
