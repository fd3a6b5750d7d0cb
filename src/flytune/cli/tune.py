"""`flytune tune`."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter

from flytune.cli.options import Edits, EveryTaskTrainerName, Flag, Folder, Real, Whole, assignments
from flytune.errors import BadInput, Unmet
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
            help=f"how to learn: {' and '.join(trainer_names(warm_start=True))} continues from the last policy, "
            "the others start from new weights"
        ),
    ] = DEFAULT_TRAINER
    steps: Annotated[Whole, Parameter(help="largest number of edits")] = 12
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
    from flytune.report.tuning import write_tuning
    from flytune.training.progress import show_progress
    from flytune.tuning.requirement import make_requirement
    from flytune.tuning.rules import load_rules
    from flytune.tuning.search import new_tuning_directory, tune

    requirement = make_requirement(
        options.settling_time, options.overshoot, options.error, at_most=options.at_most,
        tolerance=options.tolerance, axis=options.axis, percentile=options.percentile,
    )  # fmt: skip
    rules = load_rules(options.rules)
    if options.resume and options.out is None:
        raise BadInput("resume: needs --out DIR, the tuning to continue.")
    out = options.out or new_tuning_directory(requirement)
    with show_progress() as on_progress:
        result = tune(requirement, rules, out, task=task, edits=assignments(options.edits), seed=options.seed,
                      trainer=options.trainer, most_steps=options.steps, resume=options.resume,
                      tell=lambda line: print(line, flush=True), on_progress=on_progress)  # fmt: skip
    write_tuning(out / "report.html", result.to_dict())
    print(out)
    if not result.met:
        raise Unmet(result.why())
