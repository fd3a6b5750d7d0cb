"""`flytune tune`."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter

from flytune.cli.options import Edits, EveryTaskTrainerName, Flag, Folder, Real, Whole, assignments
from flytune.errors import Unmet
from flytune.training.trainer import DEFAULT_TRAINER, trainer_names


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class TuneOptions:
    """The response that is wanted, and how it is looked for."""

    settling_time: Annotated[
        Real,
        Parameter(metavar="S", help="wanted settling time, in seconds: the median over the trials"),
    ]
    at_most: Annotated[Flag, Parameter(help="the settling time is an upper bound, not a target")] = False
    tolerance: Annotated[Real, Parameter(metavar="PCT", help="tolerance of the settling time, in percent of it")] = 10.0
    overshoot: Annotated[Real, Parameter(metavar="PCT", help="largest median overshoot, in percent of the step")] = 5.0
    error: Annotated[
        Real | None,
        Parameter(metavar="M", help="largest median steady-state error, in metres (default: 0.01); yaw: degrees (1)"),
    ] = None
    axis: Annotated[Literal["position", "x", "y", "z", "yaw"], Parameter(help="the axis whose response counts")] = (
        "position"
    )
    percentile: Annotated[
        Real, Parameter(metavar="PCT", help="percentile of the trials that the settling time is taken at")
    ] = 50.0
    edits: Annotated[
        Edits, Parameter(help="fix a field of the task: the tuner does not change it, and keeps a bound set here")
    ] = ()
    rules: Annotated[
        Path | None,
        Parameter(metavar="FILE.toml", help="your own rules, beside those that `flytune rules` prints"),
    ] = None
    trainer: Annotated[
        EveryTaskTrainerName,
        Parameter(
            help=f"how to learn: {' and '.join(trainer_names(tuning_goes_on=True))} continues from the last policy, "
            "the others start from new weights"
        ),
    ] = DEFAULT_TRAINER
    most_iterations: Annotated[
        Whole, Parameter(name=("--iterations", "--steps"), help="largest number of edits, each with a training")
    ] = 12
    seed: Annotated[Whole, Parameter(help="seed of the trainings")] = 0
    out: Annotated[Folder, Parameter(help="run directory (default: a new one under runs/)")] = None
    resume: Annotated[Flag, Parameter(help="continue the tuning in --out")] = False


TuneTask = Annotated[
    str | None,
    Parameter(
        name="TASK",
        help="the task to begin with, a preset or a TOML file (default: the known task that settles nearest)",
    ),
]


def tune(task: TuneTask = None, /, *, options: TuneOptions) -> None:
    """Ask for a step response: the task is edited by rules and trained, until the controller flies like that."""
    from flytune.training.progress import show_progress
    from flytune.tuning.tune import tune

    with show_progress() as on_progress:
        result = tune(
            **vars(options) | {"task": task, "edits": assignments(options.edits)},
            on_message=lambda line: print(line, flush=True),
            on_progress=on_progress,
        )
    print(result.directory)
    if not result.met:
        raise Unmet(result.why())
