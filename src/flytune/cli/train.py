"""`flytune train`."""

import json
import sys
from typing import Annotated

from cyclopts import Parameter

from flytune.cli.options import AsJson, Edits, Flag, Folder, Task, TrainerName, Whole, assignments
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
    as_json: AsJson = False,
) -> None:
    """Train a policy for a task, and print its run directory last."""
    from flytune.control.policy import save_policy
    from flytune.control.response_map import ResponseMap
    from flytune.evaluation.evaluate import evaluate, write_evaluation
    from flytune.evaluation.measure_map import with_maps
    from flytune.runs.directory import new_directory, read_facts
    from flytune.task.files import load_task
    from flytune.training.loop import train
    from flytune.training.progress import show_progress

    changes = assignments(edits)
    find_trainer(trainer).check_edits(changes)
    wanted = load_task(task, changes)
    if steps is not None:
        wanted = find_trainer(trainer).with_steps(wanted, steps)
    if resume and out is None:
        raise BadInput("resume: needs --out DIR, the run to continue.")
    out = out or new_directory(f"{wanted.name}-{trainer}-s{seed}")
    with show_progress() as on_progress:
        run = train(
            wanted, trainer, seed=seed, out=out, resume=resume, tensorboard=tensorboard, on_progress=on_progress
        )
    if wanted.dial:
        print("measuring the response at each setting of the dial", file=sys.stderr)
        policy = with_maps(run.policy, wanted)
        save_policy(out / "policy.safetensors", policy)
        for each in policy.maps.values() if not as_json else ():
            print(ResponseMap.read(each).table(), end="\n\n")
    evaluation = evaluate(run.policy, wanted, name=str(out))
    write_evaluation(out, evaluation.judgement)
    if as_json:
        result = {"run": read_facts(out), "evaluation": evaluation.judgement.to_dict()}
        print(json.dumps({"schema": 1, "directory": str(out), **result}))
        return
    print(evaluation.judgement.line())
    print(out)
