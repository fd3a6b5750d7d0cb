"""`flytune train`."""

import json
import sys
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter

from flytune.cli.completion import controllers
from flytune.cli.options import AsJson, Edits, Flag, Folder, Task, TrainerName, Whole, assignments, check_folder_name
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
    source: Annotated[
        str | None,
        Parameter(
            name="--from",
            metavar="CONTROLLER",
            completer=controllers,
            help="go on from a policy in a new run, for instance with another vehicle or other weights: a run "
            "directory, a policy file, or a policy that ships. A run of ppo also gives its critic to ppo; else the "
            "critic is new",
        ),
    ] = None,
    resume: Annotated[Flag, Parameter(help="continue the training in --out from its checkpoint")] = False,
    tensorboard: Annotated[Flag, Parameter(help="write event files for TensorBoard as well")] = False,
    as_json: AsJson = False,
) -> None:
    """Train a policy for a task, and print its run directory last."""
    from flytune.control.policy import save_policy
    from flytune.control.response_map import ResponseMap
    from flytune.evaluation.evaluate import evaluate, write_evaluation
    from flytune.evaluation.measure_map import with_maps
    from flytune.runs.directory import read_facts
    from flytune.task.files import load_task
    from flytune.training.loop import train
    from flytune.training.progress import show_progress

    check_folder_name(out)
    changes = assignments(edits)
    find_trainer(trainer).check_edits(changes)
    wanted = load_task(task, changes)
    if steps is not None:
        wanted = find_trainer(trainer).with_steps(wanted, steps)
    if resume and out is None:
        raise BadInput("resume: needs --out DIR, the run to continue.")
    if resume and source is not None:
        raise BadInput("from: is not allowed with --resume, which continues from a checkpoint. Leave out --from.")
    start = None if source is None else _start(source, wanted, trainer)
    ended = _ended(out) if resume and out is not None else ""
    with _directory(out, task, wanted, trainer, seed, source) as out, show_progress() as on_progress:
        run = train(
            wanted, trainer, seed=seed, out=out, resume=resume, warm_start=start, tensorboard=tensorboard,
            on_progress=on_progress,
        )  # fmt: skip
    if ended:
        print(ended, file=sys.stderr)
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


def _start(source: str, wanted: Any, trainer: str) -> Any:
    """What a training goes on from, and a line about it.

    Raises:
        BadInput: it is no policy with weights, or does not fit the task.
    """
    from flytune.training.warm_start import find_warm_start

    start = find_warm_start(source, wanted, "from")
    find_trainer(trainer).check_warm_start(wanted, start.policy, "from")
    made_for = ", ".join(f"{name} {start.facts[name]}" for name in ("task", "vehicle") if start.facts[name])
    critic = "" if trainer != "ppo" else "; the critic is that of the run" if start.critic else "; the critic is new"
    print(f"starting from {source}{f' ({made_for})' if made_for else ''}{critic}", file=sys.stderr)
    return start


def _ended(out: Path) -> str:
    """A line on a run of which nothing is left to train, and how to go on; nothing for any other directory."""
    from flytune.runs.directory import read_facts
    from flytune.training.warm_start import continue_command

    facts = read_facts(out) if (out / "run.json").exists() else {}
    if not facts.get("finished") or not TRAINERS[facts["trainer"]].supports_warm_start:
        return ""
    return (
        f"{out}: this training had ended before. To go on from its policy: "
        f"{continue_command(out, facts['trainer'], facts['seed'])}"
    )


def _directory(
    out: Path | None, task: str, wanted: Any, trainer: str, seed: int, source: str | None
) -> AbstractContextManager[Path]:
    """The run directory; a new one under `runs/` is named by task, trainer and seed, and by what was changed."""
    from flytune.config import document, nested
    from flytune.runs.naming import new_directory, run_name
    from flytune.task.files import load_task

    if out is not None:
        return nullcontext(out)
    changes = nested.changes(document.plain(load_task(task)), document.plain(wanted))
    if source is not None:
        changes["from"] = source
    return new_directory(run_name(f"{wanted.name}-{trainer}-s{seed}", changes))
