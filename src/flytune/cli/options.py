"""Options that several commands share, as types; and the checks of the files a command is going to write."""

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from cyclopts import Parameter, Token

from flytune.cli.completion import completed_by, controllers, edits, tasks
from flytune.config.files import check_file
from flytune.errors import BadInput
from flytune.training.trainer import trainer_names

TASK_HELP = (
    "a preset (baseline, acrobatic, inspection, or one of them with -refined; dial), a TOML file, or a run directory"
)
CONTROLLER_HELP = (
    "a run directory, a policy file (.safetensors, .onnx, or a .zip of Stable-Baselines3), a policy that ships "
    "(baseline-refined, or baseline-refined@ppo), or pid, geometric, lqr (with @textbook: gains that were not tuned); "
    "a policy with a dial may be followed by its setting (dial@speed=0.5, dial@settling_time=4)"
)


def whole_number(text: str) -> int:
    """The whole number of a text, which may be written as a float: 1e6, 100.0.

    Raises:
        ValueError: it is none.
    """
    try:
        return int(text)
    except ValueError:
        number = float(text)
        if not number.is_integer():
            raise
        return int(number)


FILES = (".html", ".htm", ".json", ".jsonl", ".npz", ".csv", ".onnx", ".safetensors", ".zip", ".toml")  # no folders


def number_reader(kind: Callable[[str], float], allowed: str) -> Callable[[type, Sequence[Token]], Any]:
    """A converter for options that are numbers: 3.7 is no whole number, and is refused instead of rounded."""

    def read(_: type, tokens: Sequence[Token]) -> Any:
        try:
            return kind(tokens[0].value)
        except ValueError:
            raise ValueError(allowed) from None

    return read


if TYPE_CHECKING:  # a type checker cannot read a list that is made at run time
    TrainerName = EveryTaskTrainerName = str
else:
    TrainerName = Literal[trainer_names()]
    EveryTaskTrainerName = Literal[trainer_names(every_task=True)]

Task = Annotated[str, Parameter(name="TASK", help=TASK_HELP), completed_by(tasks)]
Controller = Annotated[str, Parameter(name="CONTROLLER", help=CONTROLLER_HELP), completed_by(controllers)]
Controllers = Annotated[tuple[str, ...], Parameter(name="CONTROLLER", help=CONTROLLER_HELP), completed_by(controllers)]
Whole = Annotated[int, Parameter(metavar="N", converter=number_reader(whole_number, "a whole number"))]
Real = Annotated[float, Parameter(converter=number_reader(float, "a number"))]
Flag = Annotated[bool, Parameter(negative=(), show_default=False)]
Assignments = Annotated[
    tuple[str, ...], Parameter(metavar="PATH=VALUE", consume_multiple=(1, None), negative=(), show_default=False)
]
Folder = Annotated[Path | None, Parameter(name="--out", metavar="DIR")]
Edits = Annotated[Assignments, Parameter(name="--set"), completed_by(edits)]
AsJson = Annotated[Flag, Parameter(name="--json", help="print one JSON object instead, and messages to standard error")]


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class FlightOptions:
    """How controllers are flown."""

    task: Annotated[
        str | None,
        Parameter(
            metavar="TASK",
            help=f"the task to fly: {TASK_HELP} (default: the one it was trained for; of several controllers, that of "
            "the first learned policy)",
            completer=tasks,
        ),
    ] = None
    simulator: Annotated[
        Literal["flytune", "pybullet", "mujoco"], Parameter(name="--world", help="the simulator to fly in")
    ] = "flytune"
    simulator_options: Annotated[
        Assignments,
        Parameter(
            name="--world-set",
            metavar="NAME=VALUE",
            help="options of the simulator: damping=0.04 ground_effect=true ...",
        ),
    ] = ()
    trials: Annotated[Whole, Parameter(help="number of trials")] = 100
    seed: Annotated[Whole, Parameter(help="seed of the initial conditions and of the noise")] = 1
    duration: Annotated[
        Real | None,
        Parameter(metavar="S", help="length of each trial, in seconds (default: the task's own)"),
    ] = None
    initial_conditions: Annotated[
        Literal["clear", "paper"],
        Parameter(
            name="--starts", help="initial conditions: those of the paper, or only those of them at least 0.1 m high"
        ),
    ] = "clear"

    dial: Annotated[
        Assignments,
        Parameter(
            name="--dial",
            metavar="NAME=VALUE",
            help="set the dials of a policy: speed=0.5; or turn them in flight, at times in seconds: "
            "'speed=[[0, 0.3], [5, 1.0]]'",
        ),
    ] = ()

    changes: Annotated[
        Assignments,
        Parameter(
            name="--set",
            help="what the controller meets in place of what it was told, of the vehicle or the noise: "
            "vehicle.mass=0.036 ...",
        ),
        completed_by(edits),
    ] = ()

    def settings(self) -> dict[str, Any]:
        """The keyword arguments of `flytune.evaluate`."""
        read = {name: assignments(getattr(self, name)) for name in ("simulator_options", "dial", "changes")}
        return vars(self) | read


FLIGHT_DEFAULTS = FlightOptions()


def assignments(texts: Sequence[str]) -> dict[str, Any]:
    """Path and value of each PATH=VALUE; the last one of a path counts, as with every option.

    Raises:
        BadInput: a text that is no assignment.
    """
    from flytune.config.document import parse_assignment

    return dict(map(parse_assignment, texts))


def check_folder(folder: Path | None, controller: str = "") -> None:
    """Refuse a folder that cannot be written, or that holds the run of another controller, before anything flies.

    Raises:
        BadInput: it is a file, has the name of one, or is another run.
    """
    check_folder_name(folder)
    if folder is None or not os.path.exists(folder):
        return
    if not os.path.isdir(folder):
        raise BadInput(f"out: {folder} is a file. Allowed: a folder, which may be new.")
    own = os.path.isdir(controller) and os.path.samefile(folder, controller)
    if not own and os.path.exists(folder / "run.json"):
        raise BadInput(f"out: {folder} is the run directory of another training. Give another folder.")


def check_folder_name(folder: Path | None) -> None:
    """Refuse a new folder with the name of a file that flytune writes.

    Raises:
        BadInput: its name is one.
    """
    if folder is not None and folder.suffix in FILES and not os.path.exists(folder):
        raise BadInput(
            f"out: {folder} is the name of a file. Allowed: a folder, which may be new. Did you mean "
            f"{folder.with_suffix('')}?"
        )


def check_flights(*files: Path) -> None:
    """Refuse files of trajectories that cannot be written, or that would replace something else.

    Raises:
        BadInput: one of them.
    """
    from flytune.evaluation.flights import MARK

    for file in files:
        check_file(file, "flights", mark=MARK, kind="a file of flights", suffixes=[".npz"])
