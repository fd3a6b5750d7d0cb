"""`flytune tune`."""

import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from cyclopts import Parameter

from flytune.cli.completion import tasks
from flytune.cli.options import (
    AsJson,
    Edits,
    EveryTaskTrainerName,
    Flag,
    Folder,
    Real,
    Whole,
    assignments,
    check_folder_name,
)
from flytune.errors import BadInput, Unmet
from flytune.training.trainer import DEFAULT_TRAINER, trainer_names

PER_AXIS = ("overshoot", "error", "percentile")  # options that may differ from axis to axis
PerAxis = Annotated[tuple[str, ...], Parameter(consume_multiple=(1, None), negative=(), show_default=False)]


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
    overshoot: Annotated[
        PerAxis,
        Parameter(metavar="[AXIS=]PCT", help="largest median overshoot, in percent of the step (default: 5)"),
    ] = ()
    error: Annotated[
        PerAxis,
        Parameter(
            metavar="[AXIS=]M", help="largest median steady-state error, in metres (default: 0.01); yaw: degrees (1)"
        ),
    ] = ()
    axis: Annotated[
        tuple[Literal["position", "x", "y", "z", "yaw"], ...],
        Parameter(
            consume_multiple=(1, None),
            negative=(),
            show_default=", ".join,
            help="the axis whose response counts; or several: the first one settles in the time asked for, the others "
            "settle no later",
        ),
    ] = ("position",)
    percentile: Annotated[
        PerAxis,
        Parameter(
            metavar="[AXIS=]PCT", help="percentile of the trials that the settling time is taken at (default: 50)"
        ),
    ] = ()
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

    def arguments(self) -> dict[str, Any]:
        """The keyword arguments of `flytune.tune`."""
        given = {name: per_axis(name, getattr(self, name)) for name in PER_AXIS if getattr(self, name)}
        others = {name: value for name, value in vars(self).items() if name not in PER_AXIS}
        return {**others, **given, "edits": assignments(self.edits)}


def per_axis(name: str, texts: Sequence[str]) -> float | dict[str, float]:
    """The number that an option gives for all axes, or axis -> number; "" stands for all others.

    Raises:
        BadInput: a text that is no number.
    """
    found: dict[str, float] = {}
    for text in texts:
        axis, _, value = text.rpartition("=")
        try:
            found[axis] = float(value)
        except ValueError:
            raise BadInput(
                f"--{name}: {text!r} is not allowed. Allowed: a number, or AXIS=NUMBER for one axis, as in yaw=2."
            ) from None
    return found[""] if list(found) == [""] else found


TuneTask = Annotated[
    str | None,
    Parameter(
        name="TASK",
        help="the task to begin with, a preset or a TOML file (default: the known task that settles nearest)",
        completer=tasks,
    ),
]


def tune(task: TuneTask = None, /, *, options: TuneOptions, as_json: AsJson = False) -> None:
    """Ask for a step response: the task is edited by rules and trained, until the controller flies like that."""
    from flytune.training.progress import show_progress
    from flytune.tuning.tune import tune

    check_folder_name(options.out)
    with show_progress() as on_progress:
        result = tune(
            **options.arguments(),
            task=task,
            on_message=lambda line: print(line, file=sys.stderr if as_json else sys.stdout, flush=True),
            on_progress=on_progress,
        )
    print(json.dumps({"schema": 1, **result.to_dict()}) if as_json else result.directory)
    if not result.met:
        raise Unmet(result.why())
