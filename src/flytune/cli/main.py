"""The command line: it parses the options, calls the library and prints. Only a command that needs JAX imports it."""

import gc
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import App, CycloptsError, Parameter

import flytune
from flytune.cli import bench, evaluate, export, judge, reproduce, response_map, rules, show, train, tune, vehicle
from flytune.cli.completion import script
from flytune.cli.refusal import refusal
from flytune.errors import BadInput, FlytuneError, check_installed

SINGLE_THREADED = "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"
COMMANDS = (
    train.train,
    evaluate.evaluate,
    evaluate.compare,
    evaluate.report,
    judge.judge,
    response_map.map,
    tune.tune,
    rules.rules,
    reproduce.reproduce,
    export.export,
    show.list,
    show.show,
    vehicle.vehicle,
    bench.bench,
)
Shell = Annotated[Literal["bash", "zsh", "fish"], Parameter(name="SHELL", help="the shell that shall complete")]


def make_app() -> App:
    """The commands of flytune and their options."""
    app = App(
        name="flytune",
        help="Ask for a step response, get a trained quadrotor controller, and see how it flies.",
        help_epilogue="Start with: flytune train baseline. `flytune COMMAND --help` explains the options of a command. "
        "Exit codes: 0 done, 2 bad input, 3 the numbers diverged, 4 tune could not meet the requirement, "
        "130 interrupted.",
        help_format="plaintext",
        version=lambda: flytune.__version__,
        # an option that is given twice counts as given last, so that a script can put its own behind the user's
        default_parameter=Parameter(allow_repeating=True),
    )

    def completion(shell: Shell, /) -> None:
        """Print a script that completes what is typed. In bash: source <(flytune completion bash)"""
        print(script(app, shell))

    for number, command in enumerate((*COMMANDS, completion)):
        app.command(command, sort_key=number, help_epilogue="")
    return app


def main(arguments: Sequence[str] | None = None) -> int:
    """The exit code of one command: 0 done, 2 bad input, 3 diverged, 4 requirement not met, 130 interrupted."""
    gc.set_threshold(100_000, 50, 100)  # the default looks for garbage so often that it costs half a second
    _prepare_jax()
    try:
        command, bound, _ = _parse(sys.argv[1:] if arguments is None else arguments)
        if command.__module__.startswith("flytune"):  # neither --help nor --version, which are to answer at once
            check_installed()
        command(*bound.args, **bound.kwargs)
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


def _parse(arguments: Sequence[str]):
    """The function of the command that was typed, and its arguments."""
    try:
        return make_app().parse_args(list(arguments), exit_on_error=False, print_error=False)
    except CycloptsError as error:
        raise BadInput(refusal(error)) from None


def _prepare_jax() -> None:
    """Set what JAX reads when it is first imported; what the user has set stays."""
    # one thread is as fast at this size, and makes results the same bit by bit
    flags = os.environ.get("XLA_FLAGS", "")
    if "xla_cpu_multi_thread_eigen" not in flags:
        os.environ["XLA_FLAGS"] = f"{flags} {SINGLE_THREADED}".strip()
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "flytune" / "xla"
    os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(cache))
    os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.5")
