"""`flytune train`."""

from dataclasses import dataclass
from typing import Annotated

from cyclopts import Parameter

from flytune.cli.options import Edits, Flag, Folder, Steps, Task, TrainerName, Whole, assignments
from flytune.errors import BadInput
from flytune.training.trainer import DEFAULT_TRAINER, TRAINERS, find_trainer


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class TrainOptions:
    """How a policy is trained."""

    trainer: Annotated[
        TrainerName,
        Parameter(help="how to learn: " + "; ".join(f"{each.name}: {each.summary}" for each in TRAINERS.values())),
    ] = DEFAULT_TRAINER
    seed: Annotated[Whole, Parameter(help="seed of the weights, the episodes and the noise")] = 0
    steps: Steps = None
    out: Annotated[Folder, Parameter(help="run directory (default: a new one under runs/)")] = None
    edits: Annotated[
        Edits, Parameter(help="change the task: reward.velocity.weight=0.08 vehicle=crazyflie-measured ...")
    ] = ()
    resume: Annotated[Flag, Parameter(help="continue the training in --out from its checkpoint")] = False
    tensorboard: Annotated[Flag, Parameter(help="write event files for TensorBoard as well")] = False


def train(task: Task, /, *, options: TrainOptions = TrainOptions()) -> None:
    """Train a policy for a task, and print its run directory last."""
    from flytune.evaluation.evaluate import evaluate, write_evaluation
    from flytune.runs.directory import new_directory
    from flytune.task.task import load_task
    from flytune.training.loop import train
    from flytune.training.progress import show_progress

    wanted = load_task(task, assignments(options.edits))
    if options.steps is not None:
        wanted = find_trainer(options.trainer).with_steps(wanted, options.steps)
    if options.resume and options.out is None:
        raise BadInput("resume: needs --out DIR, the run to continue.")
    out = options.out or new_directory(f"{wanted.name}-{options.trainer}-s{options.seed}")
    with show_progress() as on_progress:
        run = train(wanted, options.trainer, seed=options.seed, out=out, resume=options.resume,
                    tensorboard=options.tensorboard, on_progress=on_progress)  # fmt: skip
    evaluation = evaluate(run.policy, wanted, name=str(out))
    write_evaluation(out, evaluation.judgement)
    print(evaluation.judgement.line())
    print(out)
