"""The command line: parse, call, print. JAX is imported only by the commands that need it."""

import argparse
import json
import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NoReturn

from flytune.errors import BadInput, FlytuneError

SINGLE_THREADED = "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"


def main(arguments: Sequence[str] | None = None) -> int:
    """The exit code of one command: 0 done, 2 bad input, 3 diverged, 130 interrupted."""
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
        epilog="Start with: flytune train baseline. Exit codes: 0 done, 2 bad input, 3 diverged, 130 interrupted.",
    )
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", required=True)
    for add in (_add_train, _add_evaluate, _add_report, _add_show, _add_bench):
        add(commands)
    return parser


def _command(commands: Any, name: str, run: Callable[[argparse.Namespace], None], text: str) -> argparse.ArgumentParser:
    command = commands.add_parser(
        name, help=text, description=text, formatter_class=argparse.ArgumentDefaultsHelpFormatter
    )
    command.set_defaults(run=run)
    return command


TASK_HELP = "a preset (baseline, acrobatic, inspection) or a TOML file"
WHO_HELP = "a run directory or a .safetensors policy"


def _add_train(commands: Any) -> None:
    command = _command(commands, "train", _train, "train a policy for a task; prints the run directory last")
    command.add_argument("task", metavar="TASK", help=TASK_HELP)
    command.add_argument("--trainer", choices=("apg", "ppo"), default="apg", help="how to learn")
    command.add_argument("--seed", type=int, default=0, help="of weights, episodes and noise")
    command.add_argument("--steps", type=int, default=argparse.SUPPRESS, metavar="N",
                         help="environment steps in all (default: the task's own)")  # fmt: skip
    command.add_argument("--out", type=Path, default=argparse.SUPPRESS, metavar="DIR",
                         help="run directory (default: a new one under runs/)")  # fmt: skip
    command.add_argument("--set", nargs="+", action="extend", default=[], metavar="PATH=VALUE", dest="edits",
                         help="edit the task: reward.velocity.weight=0.08 vehicle=crazyflie-measured ...")  # fmt: skip
    command.add_argument("--resume", action="store_true", help="go on from the checkpoint in --out")


def _add_trial_options(command: argparse.ArgumentParser) -> None:
    command.add_argument("--task", default=argparse.SUPPRESS, metavar="TASK",
                         help=f"{TASK_HELP} (default: the one it was trained for)")  # fmt: skip
    command.add_argument("--world", choices=("flytune",), default="flytune", help="the simulator to fly in")
    command.add_argument("--trials", type=int, default=100, help="number of trials")
    command.add_argument("--seed", type=int, default=1, help="of starts and noise")
    command.add_argument("--duration", type=float, default=argparse.SUPPRESS, metavar="S",
                         help="of each trial, in seconds (default: the task's own)")  # fmt: skip
    command.add_argument("--starts", choices=("clear", "paper"), default="clear",
                         help="the paper's starts, or those of them at least 0.1 m high")  # fmt: skip


def _add_evaluate(commands: Any) -> None:
    command = _command(commands, "evaluate", _evaluate, "fly many trials and judge the step response")
    command.add_argument("who", metavar="WHO", help=WHO_HELP)
    _add_trial_options(command)
    command.add_argument("--json", action="store_true", help="print one JSON object instead of the table")
    command.add_argument("--out", type=Path, default=argparse.SUPPRESS, metavar="DIR",
                         help="where to write evaluation.json (default: the run directory)")  # fmt: skip
    command.add_argument("--flights", type=Path, default=argparse.SUPPRESS, metavar="FILE.npz",
                         help="write the trajectories, with named columns")  # fmt: skip


def _add_report(commands: Any) -> None:
    command = _command(
        commands, "report", _report, "print the tables of one or more pilots, and write one self-contained HTML page"
    )
    command.add_argument("who", metavar="WHO", nargs="+", help=WHO_HELP)
    _add_trial_options(command)
    command.add_argument("--out", type=Path, default=Path("report.html"), metavar="FILE", help="the page")


def _add_show(commands: Any) -> None:
    command = _command(commands, "show", _show, "print a task as TOML, each number with unit, range and source")
    command.add_argument("task", metavar="TASK", help=TASK_HELP)


def _add_bench(commands: Any) -> None:
    command = _command(commands, "bench", _bench, "measure throughput on this machine")
    command.add_argument("what", nargs="?", choices=("all", "train", "simulate"), default="all", help="what to measure")
    command.add_argument("--json", action="store_true", help="print one JSON object instead of the table")


def _train(options: argparse.Namespace) -> None:
    from flytune import document
    from flytune.learn.directory import new_directory
    from flytune.learn.progress import show_progress
    from flytune.learn.run import train, with_steps
    from flytune.response.fly import fly
    from flytune.response.judge import judge
    from flytune.task.task import load_task

    task = load_task(options.task, dict(map(document.parse_assignment, options.edits)))
    if "steps" in options:
        task = with_steps(task, options.trainer, options.steps)
    if options.resume and "out" not in options:
        raise BadInput("resume: needs --out DIR, the run to go on with.")
    out = options.out if "out" in options else new_directory(task, options.trainer, options.seed)
    with show_progress() as on_progress:
        run = train(task, options.trainer, seed=options.seed, out=out, resume=options.resume, on_progress=on_progress)
    judgement = judge(fly(run.policy, task, who=str(out)))
    _write_evaluation(out, judgement.to_dict())
    print(judgement.line())
    print(out)


def _evaluate(options: argparse.Namespace) -> None:
    from flytune.learn.pilot import find_pilot
    from flytune.response.judge import judge

    if "flights" in options:
        _check_file("flights", options.flights)
    if "out" in options and os.path.exists(options.out) and not os.path.isdir(options.out):
        raise BadInput(f"out: {options.out} is a file. Give a directory.")
    pilot = find_pilot(options.who)
    flights, _ = _fly(pilot, options)
    judgement = judge(flights)
    if "flights" in options:
        flights.save(options.flights)
    print(json.dumps(judgement.to_dict()) if options.json else judgement.table(), flush=True)
    if "out" in options:
        _write_evaluation(options.out, judgement.to_dict())
    elif os.path.isdir(options.who):
        try:
            _write_evaluation(Path(options.who), judgement.to_dict())
        except BadInput as error:  # somebody else's run, perhaps; the result itself has been printed
            print(f"not kept: {error}", file=sys.stderr)


def _report(options: argparse.Namespace) -> None:
    from flytune.learn.pilot import find_pilot
    from flytune.response.judge import judge
    from flytune.show.report import Entry, write_report

    _check_file("out", options.out)
    entries = []
    for pilot in [find_pilot(who) for who in options.who]:
        flights, task = _fly(pilot, options)
        judgement = judge(flights)
        print(judgement.table(), end="\n\n")
        entries.append(
            Entry(
                name=pilot.name,
                task=task,
                flights=flights,
                judgement=judgement,
                metrics=pilot.metrics,
                about=pilot.about,
            )
        )
    write_report(options.out, entries)
    print(options.out)


def _fly(pilot: Any, options: argparse.Namespace) -> Any:
    from flytune.learn.pilot import task_for
    from flytune.response.fly import fly

    task = task_for(pilot, getattr(options, "task", None))
    flights = fly(
        pilot.controller,
        task,
        trials=options.trials,
        seed=options.seed,
        starts=options.starts,
        duration=getattr(options, "duration", None),
        who=pilot.name,
    )
    return flights, task


def _show(options: argparse.Namespace) -> None:
    from flytune.task.task import load_task, write_task

    print(write_task(load_task(options.task)), end="")


def _bench(options: argparse.Namespace) -> None:
    from flytune.learn.bench import bench

    result = bench(options.what)
    print(json.dumps(result.to_dict()) if options.json else result.table())


def _check_file(option: str, path: Path) -> None:
    """Refuse a file that cannot be written, before anything is flown."""
    if not os.path.isdir(path.parent):
        raise BadInput(f"{option}: {path.parent} is no directory. Give a file in one that exists.")
    if os.path.isdir(path):
        raise BadInput(f"{option}: {path} is a directory. Give a file.")


def _write_evaluation(folder: Path, judgement: dict[str, Any]) -> None:
    path = folder / "evaluation.json"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        whole = path.with_name(path.name + ".part")
        whole.write_text(json.dumps(judgement, indent=2) + "\n", encoding="utf-8")
        whole.replace(path)
    except OSError as error:
        raise BadInput(f"out: {path} cannot be written ({error.strerror}). Give another directory.") from None


if __name__ == "__main__":
    sys.exit(main())
