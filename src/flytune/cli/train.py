"""`flytune train`."""

import sys
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter

from flytune.cli.options import Edits, Flag, Folder, Task, TrainerName, Whole, assignments
from flytune.errors import BadInput
from flytune.training.trainer import DEFAULT_TRAINER, TRAINERS, find_trainer


def train(
    task: Task,
    /,
    *,
    trainer: Annotated[
        TrainerName,
        Parameter(help="how to learn: " + "; ".join(f"{each.name}: {each.summary}" for each in TRAINERS.values())),
    ] = DEFAULT_TRAINER,
    seed: Annotated[Whole, Parameter(help="seed of the weights, the episodes and the noise")] = 0,
    steps: Annotated[
        Whole | None, Parameter(help="number of environment steps in all (default: the task's own)")
    ] = None,
    out: Annotated[Folder, Parameter(help="run directory (default: a new one under runs/)")] = None,
    edits: Annotated[
        Edits, Parameter(help="change the task: reward.velocity.weight=0.08 vehicle=crazyflie-measured ...")
    ] = (),
    resume: Annotated[Flag, Parameter(help="continue the training in --out from its checkpoint")] = False,
    tensorboard: Annotated[Flag, Parameter(help="write event files for TensorBoard as well")] = False,
) -> None:
    """Train a policy for a task, and print its run directory last."""
    from flytune.control.policy import save_policy
    from flytune.control.response_map import ResponseMap
    from flytune.evaluation.evaluate import evaluate, write_evaluation
    from flytune.evaluation.measure_map import with_maps
    from flytune.task.files import load_task
    from flytune.training.loop import train
    from flytune.training.progress import show_progress

    wanted = load_task(task, assignments(edits))
    if steps is not None:
        wanted = find_trainer(trainer).with_steps(wanted, steps)
    if resume and out is None:
        raise BadInput("resume: needs --out DIR, the run to continue.")
    with _directory(out, task, wanted, trainer, seed) as out, show_progress() as on_progress:
        run = train(
            wanted, trainer, seed=seed, out=out, resume=resume, tensorboard=tensorboard, on_progress=on_progress
        )
    if wanted.dial:
        print("measuring the response at each setting of the dial", file=sys.stderr)
        policy = with_maps(run.policy, wanted)
        save_policy(out / "policy.safetensors", policy)
        for each in policy.maps.values():
            print(ResponseMap.read(each).table(), end="\n\n")
    evaluation = evaluate(run.policy, wanted, name=str(out))
    write_evaluation(out, evaluation.judgement)
    print(evaluation.judgement.line())
    print(out)


def _directory(out: Path | None, task: str, wanted: Any, trainer: str, seed: int) -> AbstractContextManager[Path]:
    """The run directory; a new one under `runs/` is named by task, trainer and seed, and by what was changed."""
    from flytune.config import document, nested
    from flytune.runs.naming import new_directory, run_name
    from flytune.task.files import load_task

    if out is not None:
        return nullcontext(out)
    changes = nested.changes(document.plain(load_task(task)), document.plain(wanted))
    return new_directory(run_name(f"{wanted.name}-{trainer}-s{seed}", changes))
