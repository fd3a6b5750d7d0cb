"""The command line: parse, call, print. JAX is imported only by the commands that need it."""

import argparse
import json
import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NoReturn

from flytune.config.files import check_file, make_folder, write_json
from flytune.errors import BadInput, FlytuneError, Unmet

SINGLE_THREADED = "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"


def main(arguments: Sequence[str] | None = None) -> int:
    """The exit code of one command: 0 done, 2 bad input, 3 diverged, 4 requirement not met, 130 interrupted."""
    _prepare_jax()
    try:
        options = _parser().parse_args(arguments)
        options.run(options)
        sys.stdout.flush()
    except FlytuneError as error:
        print(error, file=sys.stderr)
        return error.exit_code
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return 130
    except BrokenPipeError:
        # the reader went away (| head); keep the interpreter from complaining when it closes standard output
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    return 0


def _prepare_jax() -> None:
    """Settings JAX reads when it is first imported; what the user has set stays."""
    # one thread is as fast at this size, and makes results the same bit by bit
    flags = os.environ.get("XLA_FLAGS", "")
    if "xla_cpu_multi_thread_eigen" not in flags:
        os.environ["XLA_FLAGS"] = f"{flags} {SINGLE_THREADED}".strip()
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "flytune" / "xla"
    os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(cache))
    os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.5")


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        raise BadInput(f"{message}. See {self.prog} --help")


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(
        prog="flytune",
        description="Ask for a step response, get a trained quadrotor controller, and see how it flies.",
        epilog="Start with: flytune train baseline. Exit codes: 0 done, 2 bad input, 3 diverged, "
        "4 tune could not meet the requirement, 130 interrupted.",
    )
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", required=True)
    for add in (_add_train, _add_evaluate, _add_compare, _add_report, _add_tune,
                _add_rules, _add_reproduce, _add_export, _add_show, _add_bench):  # fmt: skip
        add(commands)
    return parser


def _command(commands: Any, name: str, run: Callable[[argparse.Namespace], None], text: str) -> argparse.ArgumentParser:
    command = commands.add_parser(
        name, help=text, description=text, formatter_class=argparse.ArgumentDefaultsHelpFormatter
    )
    command.set_defaults(run=run)
    return command


TASK_HELP = "a preset (baseline, acrobatic, inspection, or one of them -refined) or a TOML file"
WHO_HELP = (
    "a run directory, a policy (.safetensors, .onnx, or a .zip of Stable-Baselines3), a policy that ships "
    "(baseline-refined, or baseline-refined@ppo), or pid, geometric, lqr (add @textbook for gains that were not tuned)"
)
SIMULATORS = ("flytune", "pybullet", "mujoco")


def _add_train(commands: Any) -> None:
    command = _command(commands, "train", _train, "train a policy for a task; prints the run directory last")
    command.add_argument("task", metavar="TASK", help=TASK_HELP)
    command.add_argument("--trainer", choices=("apg", "ppo", "sb3"), default="apg", help="how to learn")
    command.add_argument("--seed", type=int, default=0, help="of weights, episodes and noise")
    command.add_argument("--steps", type=int, default=argparse.SUPPRESS, metavar="N",
                         help="environment steps in all (default: the task's own)")  # fmt: skip
    command.add_argument("--out", type=Path, default=argparse.SUPPRESS, metavar="DIR",
                         help="run directory (default: a new one under runs/)")  # fmt: skip
    command.add_argument("--set", nargs="+", action="extend", default=[], metavar="PATH=VALUE", dest="edits",
                         help="edit the task: reward.velocity.weight=0.08 vehicle=crazyflie-measured ...")  # fmt: skip
    command.add_argument("--resume", action="store_true", help="go on from the checkpoint in --out")
    command.add_argument("--tensorboard", action="store_true", help="write event files for TensorBoard as well")


def _add_trial_options(command: argparse.ArgumentParser) -> None:
    command.add_argument("--task", default=argparse.SUPPRESS, metavar="TASK",
                         help=f"{TASK_HELP} (default: the one it was trained for)")  # fmt: skip
    command.add_argument(
        "--world", dest="simulator", choices=SIMULATORS, default="flytune", help="the simulator to fly in"
    )
    command.add_argument("--world-set", nargs="+", action="extend", default=[], metavar="NAME=VALUE",
                         dest="simulator_edits", help="its options: damping=0.04 ground_effect=true ...")  # fmt: skip
    command.add_argument("--trials", type=int, default=100, help="number of trials")
    command.add_argument("--seed", type=int, default=1, help="of starts and noise")
    command.add_argument("--duration", type=float, default=argparse.SUPPRESS, metavar="S",
                         help="of each trial, in seconds (default: the task's own)")  # fmt: skip
    command.add_argument("--starts", dest="initial_conditions", choices=("clear", "paper"), default="clear",
                         help="the paper's starts, or those of them at least 0.1 m high")  # fmt: skip


def _add_evaluate(commands: Any) -> None:
    command = _command(commands, "evaluate", _evaluate, "fly many trials and judge the step response")
    command.add_argument("name", metavar="WHO", help=WHO_HELP)
    _add_trial_options(command)
    command.add_argument("--json", action="store_true", help="print one JSON object instead of the table")
    command.add_argument("--out", type=Path, default=argparse.SUPPRESS, metavar="DIR",
                         help="where to write evaluation.json (default: the run directory)")  # fmt: skip
    command.add_argument("--flights", type=Path, default=argparse.SUPPRESS, metavar="FILE.npz",
                         help="write the trajectories, with named columns")  # fmt: skip


def _add_compare(commands: Any) -> None:
    command = _command(
        commands, "compare", _compare, "fly two or more controllers from the same starts and judge them side by side"
    )
    command.add_argument("name", metavar="WHO", nargs="+", help=WHO_HELP)
    _add_trial_options(command)
    command.add_argument("--json", action="store_true", help="print one JSON object instead of the tables")
    command.add_argument("--out", type=Path, default=argparse.SUPPRESS, metavar="DIR",
                         help="where to write comparison.html and comparison.json (default: nowhere)")  # fmt: skip
    command.add_argument("--flights", type=Path, default=argparse.SUPPRESS, metavar="FILE.npz",
                         help="write the trajectories, as FILE-1.npz, FILE-2.npz, ...")  # fmt: skip


def _add_report(commands: Any) -> None:
    command = _command(
        commands,
        "report",
        _report,
        "print the tables of one or more controllers, and write one self-contained HTML page",
    )
    command.add_argument("name", metavar="WHO", nargs="+", help=WHO_HELP)
    _add_trial_options(command)
    command.add_argument("--out", type=Path, default=Path("report.html"), metavar="FILE", help="the page")


def _add_reproduce(commands: Any) -> None:
    command = _command(
        commands, "reproduce", _reproduce, "run the paper again: three behaviours, every figure, a verdict per claim"
    )
    command.add_argument("--trainer", choices=("ppo", "apg"), default="ppo", help="how to learn; the paper's is ppo")
    command.add_argument("--seeds", type=int, default=5, help="trainings of each behaviour")
    command.add_argument("--steps", type=int, default=argparse.SUPPRESS, metavar="N",
                         help="environment steps of each training (default: the task's own)")  # fmt: skip
    command.add_argument("--refined", action="store_true", help="the refined presets in place of the printed ones")
    command.add_argument("--out", type=Path, default=argparse.SUPPRESS, metavar="DIR",
                         help="where runs, figures, verdicts and the page go; what is there is gone on with "
                         "(default: runs/reproduction-TRAINER)")  # fmt: skip
    command.add_argument("--json", action="store_true", help="print one JSON object instead of the table")


def _add_tune(commands: Any) -> None:
    command = _command(
        commands, "tune", _tune, "ask for a step response: edit the task by rules and train, until it flies like that"
    )
    command.add_argument(
        "task",
        metavar="TASK",
        nargs="?",
        default=argparse.SUPPRESS,
        help="where to begin, a preset or a TOML file (default: the known task that settles nearest)",
    )
    command.add_argument(
        "--settling-time",
        type=float,
        required=True,
        metavar="S",
        help="wanted, in seconds: the median over trials of what the position takes",
    )
    command.add_argument("--at-most", action="store_true", help="the settling time is an upper bound, not a target")
    command.add_argument(
        "--tolerance", type=float, default=10.0, metavar="PCT", help="of a target, in percent of the settling time"
    )
    command.add_argument(
        "--overshoot", type=float, default=5.0, metavar="PCT", help="at most, in percent of the step, median"
    )
    command.add_argument(
        "--error",
        type=float,
        default=argparse.SUPPRESS,
        metavar="M",
        help="steady-state error at most, in metres, median (default: 0.01; yaw: in degrees, 1)",
    )
    command.add_argument(
        "--axis", choices=("position", "x", "y", "z", "yaw"), default="position", help="whose response"
    )
    command.add_argument(
        "--percentile", type=float, default=50.0, metavar="PCT", help="of the trials, for the settling time"
    )
    command.add_argument(
        "--set",
        nargs="+",
        action="extend",
        default=[],
        metavar="PATH=VALUE",
        dest="edits",
        help="fix a field of the task: the tuner leaves it alone, and keeps a bound that is set here",
    )
    command.add_argument(
        "--rules",
        type=Path,
        default=argparse.SUPPRESS,
        metavar="FILE.toml",
        help="rules of your own, beside those that `flytune rules` prints",
    )
    command.add_argument(
        "--trainer",
        choices=("apg", "ppo"),
        default="apg",
        help="how to learn; apg goes on from the last policy, ppo begins anew",
    )
    command.add_argument("--steps", type=int, default=12, metavar="N", help="edits at most")
    command.add_argument("--seed", type=int, default=0, help="of the trainings")
    command.add_argument(
        "--out",
        type=Path,
        default=argparse.SUPPRESS,
        metavar="DIR",
        help="run directory (default: a new one under runs/)",
    )
    command.add_argument("--resume", action="store_true", help="go on with the tuning in --out")


def _add_rules(commands: Any) -> None:
    command = _command(commands, "rules", _rules, "print the heuristics of the tuner as a table")
    command.add_argument(
        "--rules", type=Path, default=argparse.SUPPRESS, metavar="FILE.toml", help="rules of your own, beside flytune's"
    )
    command.add_argument("--json", action="store_true", help="print one JSON object instead of the table")


def _add_export(commands: Any) -> None:
    command = _command(commands, "export", _export, "write a policy for elsewhere")
    command.add_argument("name", metavar="WHO", help="a run directory or a policy (.safetensors, .onnx, .zip)")
    command.add_argument("--format", choices=("onnx", "safetensors"), required=True,
                         help="onnx: for any runtime; safetensors: flytune's own, for instance of a .zip")  # fmt: skip
    command.add_argument("--out", type=Path, required=True, metavar="PATH", help="the file")


def _add_show(commands: Any) -> None:
    command = _command(commands, "show", _show, "print a task as TOML, each number with unit, range and source")
    command.add_argument("task", metavar="TASK", help=TASK_HELP)


def _add_bench(commands: Any) -> None:
    command = _command(commands, "bench", _bench, "measure throughput here, and that of what is installed beside us")
    command.add_argument("what", nargs="?", choices=("all", "train", "simulate"), default="all", help="what to measure")
    command.add_argument("--json", action="store_true", help="print one JSON object instead of the table")


def _train(options: argparse.Namespace) -> None:
    from flytune.config import document
    from flytune.evaluation.fly import fly
    from flytune.evaluation.judge import judge
    from flytune.runs.directory import new_directory
    from flytune.task.task import load_task
    from flytune.training.loop import train, with_steps
    from flytune.training.progress import show_progress

    task = load_task(options.task, dict(map(document.parse_assignment, options.edits)))
    if "steps" in options:
        task = with_steps(task, options.trainer, options.steps)
    if options.resume and "out" not in options:
        raise BadInput("resume: needs --out DIR, the run to go on with.")
    out = options.out if "out" in options else new_directory(task, options.trainer, options.seed)
    with show_progress() as on_progress:
        run = train(task, options.trainer, seed=options.seed, out=out, resume=options.resume,
                    tensorboard=options.tensorboard, on_progress=on_progress)  # fmt: skip
    judgement = judge(fly(run.policy, task, name=str(out)))
    _write_json(out / "evaluation.json", judgement.to_dict())
    print(judgement.line())
    print(out)


def _evaluate(options: argparse.Namespace) -> None:
    from flytune.evaluation.judge import judge
    from flytune.runs.find import find_controller

    _check_outputs(options)
    controller = find_controller(options.name, getattr(options, "task", None))
    flights = _fly(controller, options)
    judgement = judge(flights)
    if "flights" in options:
        flights.save(options.flights)
    print(json.dumps(judgement.to_dict()) if options.json else judgement.table(), flush=True)
    if "out" in options:
        _write_json(options.out / "evaluation.json", judgement.to_dict())
    elif os.path.isdir(options.name):
        try:
            _write_json(Path(options.name) / "evaluation.json", judgement.to_dict())
        except BadInput as error:  # somebody else's run, perhaps; the result itself has been printed
            print(f"not kept: {error}", file=sys.stderr)


def _report(options: argparse.Namespace) -> None:
    from flytune.report.report import write_report

    check_file(options.out)
    entries = _entries(options)
    print("\n\n".join(entry.judgement.table() for entry in entries), end="\n\n")
    write_report(options.out, entries)
    print(options.out)


def _compare(options: argparse.Namespace) -> None:
    from flytune.evaluation.comparison import compare
    from flytune.report.comparison import write_comparison

    _check_outputs(options)
    if len(options.name) < 2:
        raise BadInput(f"who: one controller, {options.name[0]}, cannot be compared. Give two or more.")
    entries = _entries(options)
    comparison = compare([entry.judgement for entry in entries])
    if "flights" in options:
        for number, entry in enumerate(entries, start=1):
            entry.flights.save(options.flights.with_stem(f"{options.flights.stem}-{number}"))
    print(json.dumps(comparison.to_dict()) if options.json else comparison.table(), flush=True)
    if "out" in options:
        _write_json(options.out / "comparison.json", comparison.to_dict())
        write_comparison(options.out / "comparison.html", entries, comparison)


def _entries(options: argparse.Namespace) -> list[Any]:
    """Every controller named, flown from the same starts and judged; all are found before the first one flies."""
    from flytune.evaluation.judge import judge
    from flytune.report.report import Entry
    from flytune.runs.find import find_controller

    entries = []
    for controller in [find_controller(name, getattr(options, "task", None)) for name in options.name]:
        flights = _fly(controller, options)
        entries.append(
            Entry(
                name=controller.name,
                task=controller.task,
                flights=flights,
                judgement=judge(flights),
                metrics=controller.metrics,
                about=controller.about,
            )
        )
    return entries


def _fly(controller: Any, options: argparse.Namespace) -> Any:
    from flytune.config import document
    from flytune.evaluation.fly import fly

    return fly(
        controller.controller,
        controller.task,
        trials=options.trials,
        seed=options.seed,
        initial_conditions=options.initial_conditions,
        duration=getattr(options, "duration", None),
        name=controller.name,
        simulator=options.simulator,
        simulator_options=dict(map(document.parse_assignment, options.simulator_edits)),
    )


def _tune(options: argparse.Namespace) -> None:
    from flytune.config import document
    from flytune.report.tuning import write_tuning
    from flytune.training.progress import show_progress
    from flytune.tuning.requirement import make_requirement
    from flytune.tuning.rules import load_rules
    from flytune.tuning.search import new_tuning_directory, tune

    requirement = make_requirement(
        options.settling_time, options.overshoot, getattr(options, "error", None), at_most=options.at_most,
        tolerance=options.tolerance, axis=options.axis, percentile=options.percentile,
    )  # fmt: skip
    rules = load_rules(getattr(options, "rules", None))
    if options.resume and "out" not in options:
        raise BadInput("resume: needs --out DIR, the tuning to go on with.")
    out = options.out if "out" in options else new_tuning_directory(requirement)
    with show_progress() as on_progress:
        result = tune(requirement, rules, out, task=getattr(options, "task", None),
                      edits=dict(map(document.parse_assignment, options.edits)), seed=options.seed,
                      trainer=options.trainer, most_steps=options.steps, resume=options.resume,
                      tell=lambda line: print(line, flush=True), on_progress=on_progress)  # fmt: skip
    write_tuning(out / "report.html", result.to_dict())
    print(out)
    if not result.met:
        raise Unmet(result.why())


def _rules(options: argparse.Namespace) -> None:
    from flytune.tuning.rules import load_rules, rules_table, to_dicts

    rules = load_rules(getattr(options, "rules", None))
    print(json.dumps({"schema": 1, "rules": to_dicts(rules)}) if options.json else rules_table(rules))


def _reproduce(options: argparse.Namespace) -> None:
    from flytune.reproduction.reproduction import reproduce
    from flytune.reproduction.study import Study
    from flytune.reproduction.trainings import show_all

    name = f"reproduction-{options.trainer}{'-refined' if options.refined else ''}"
    study = Study(
        folder=getattr(options, "out", Path("runs") / name),
        trainer=options.trainer,
        seeds=options.seeds,
        steps=getattr(options, "steps", None),
        refined=options.refined,
    )
    with show_all(study) as (on_progress, tell):
        result = reproduce(study, on_progress=on_progress, tell=tell)
    print(json.dumps(result.to_dict()) if options.json else result.table(), flush=True)
    if not options.json:
        print(study.folder / "report.html")


def _export(options: argparse.Namespace) -> None:
    from flytune.control.policy import Policy, save_policy
    from flytune.export.onnx import save_onnx
    from flytune.runs.find import find_controller

    check_file(options.out)
    policy = find_controller(options.name).controller
    if not isinstance(policy, Policy):
        raise BadInput(f"{options.name}: is no policy of flytune's own. Allowed: a run directory, .safetensors, .zip.")
    {"onnx": save_onnx, "safetensors": save_policy}[options.format](options.out, policy)
    print(options.out)


def _show(options: argparse.Namespace) -> None:
    from flytune.task.task import load_task, write_task

    print(write_task(load_task(options.task)), end="")


def _bench(options: argparse.Namespace) -> None:
    from flytune.bench.throughput import bench

    result = bench(options.what)
    print(json.dumps(result.to_dict()) if options.json else result.table())


def _check_outputs(options: argparse.Namespace) -> None:
    if "flights" in options:
        check_file(options.flights, "flights")
    if "out" in options and os.path.exists(options.out) and not os.path.isdir(options.out):
        raise BadInput(f"out: {options.out} is a file. Give a directory.")


def _write_json(path: Path, content: dict[str, Any]) -> None:
    make_folder(path.parent)
    write_json(path, content)


if __name__ == "__main__":
    sys.exit(main())
