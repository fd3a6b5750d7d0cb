"""What a name stands for that is in the wrong place, and how it is used; and what a wrong name may have been meant for.

Names that ship are those of the data files of the package, so that no code of other rooms is needed to know them.
"""

import os
import shlex
import tomllib
from collections.abc import Iterable, Iterator
from importlib import resources
from pathlib import Path

from flytune.config.fields import nearest

TASK, CONTROLLER, VEHICLE, FLIGHTS, RULES = "a task", "a controller", "a vehicle", "flights", "rules"  # what is wanted
SHIPPED = {"task/presets": TASK, "physics/vehicles": VEHICLE, "control/gains": CONTROLLER, "runs/policies": CONTROLLER}
SUFFIXES = {
    ".safetensors": CONTROLLER, ".onnx": CONTROLLER, ".zip": CONTROLLER,
    ".npz": FLIGHTS, ".csv": FLIGHTS, ".html": "a page",
}  # fmt: skip
KEYS = {  # at the top of a TOML file; those of the first kind that has one decide
    RULES: {"rule"},
    TASK: {"based_on", "target", "reward", "termination", "vehicle", "initial_state", "noise", "horizon", "duration",
           "apg", "ppo", "dial", "follow"},
    VEHICLE: {"mass", "inertia", "arm", "rotors", "thrust_coefficient", "torque_coefficient", "propeller_radius"},
}  # fmt: skip
USES = {
    TASK: "Train for it: flytune train {0}; or fly it: flytune evaluate pid --task {0}.",
    CONTROLLER: "Fly it: flytune evaluate {0}.",
    VEHICLE: "It is the vehicle of a task: flytune train baseline --set vehicle={0}; or in a task file the lines "
    'based_on = "baseline" and vehicle = "{0}".',
    FLIGHTS: "Judge its flights: flytune judge {0}.",
    RULES: "Tune by them: flytune tune --settling-time S --rules {0}.",
    "a run directory": "Fly its policy: flytune evaluate {0}; or see its task: flytune show {0}.",
    "a page": "Open it in a browser.",
    "a record": "Give the run directory.",
}
RUN_RECORDS = ("run.json", "metrics.jsonl", "evaluation.json")
MOST = 3  # names in a line


def misplaced(name: str, wanted: str) -> str | None:
    """The line about a name or path that is known to be something else than what is wanted, with its use; else None.

    Args:
        name: as the user typed it, or as a path.
        wanted: `TASK`, `CONTROLLER`, `VEHICLE`, `FLIGHTS` or `RULES`.
    """
    kinds = list(_kinds(name))
    if not kinds or any(kind == wanted for kind, _ in kinds):
        return None
    kind, told = kinds[0]
    use = USES[kind].format(shlex.quote(name))
    if wanted == CONTROLLER and kind == TASK:
        use = _policies_for(name) + use
    if wanted == TASK and told == "a policy file":
        use += f" Go on from it: flytune train baseline --from {shlex.quote(name)}."
    return f"{name} is {told}, not {wanted}. {use}"


def meant(name: str, wanted: str, names: Iterable[str], suffixes: Iterable[str]) -> str:
    """A hint at what an unknown name or missing file may have been meant for, after a space; or nothing.

    Args:
        name: that is neither among the names nor a path.
        wanted: see `misplaced`.
        names: that would do.
        suffixes: of files that would do, beside run directories.
    """
    path, suffixes = Path(name), tuple(suffixes)

    def would_do(place: Path) -> bool:
        if is_run(place):
            return wanted in (TASK, CONTROLLER)
        return place.suffix in suffixes and os.path.exists(place) and misplaced(str(place), wanted) is None

    same = [Path("runs") / path, *(Path(f"{name}{suffix}") for suffix in suffixes)]
    if found := next((str(each) for each in same if would_do(each)), None) or nearest(name, names):
        return f" Did you mean {found}?"
    for folder in (path.parent, *([Path("runs")] if path.name == name else [])):
        # by their stems, since all files of a kind are alike in their suffix
        there = {Path(each).stem: each for each in _entries(folder) if would_do(folder / each)}
        if near := nearest(path.stem, there):
            return f" Did you mean {folder / there[near]}?"
    return ""


def runs_in(folder: str | Path) -> str:
    """A hint at the run directories in a folder, after a space; or nothing."""
    runs = [str(Path(folder) / each) for each in _entries(Path(folder)) if is_run(Path(folder) / each)]
    return f" It holds the runs {', '.join(runs[:MOST])}{', ...' * (len(runs) > MOST)}." if runs else ""


def shipped(kind: str) -> list[str]:
    """The names of the tasks, controllers or vehicles that ship with flytune."""
    return sorted(name for folder, each in SHIPPED.items() if each == kind for name in _shipped(folder))


def is_run(path: str | Path) -> bool:
    """Whether a path is a run directory."""
    return os.path.isfile(os.path.join(path, "run.json"))


def _kinds(name: str) -> Iterator[tuple[str, str]]:
    """The kinds of a name or path, each with the words for it."""
    path = Path(name)
    if os.path.isdir(name):
        if is_run(path):
            yield "a run directory", "a run directory"
        return
    if os.path.isfile(name):
        if path.name in RUN_RECORDS and is_run(path.parent):
            yield "a record", f"a record of the run {path.parent}"
        if path.suffix == ".toml":
            kind = _kind_of_toml(path)
            if kind is not None:
                yield kind, {RULES: "a file of rules"}.get(kind, f"{kind} file")
        elif kind := SUFFIXES.get(path.suffix):
            words = {CONTROLLER: "a policy file", FLIGHTS: "a log" if path.suffix == ".csv" else "a file of arrays"}
            yield kind, words.get(kind, kind)
        return
    for folder, kind in SHIPPED.items():
        if (name.partition("@")[0] if kind == CONTROLLER else name) in _shipped(folder):
            yield kind, f"{kind} that ships with flytune"


def _kind_of_toml(path: Path) -> str | None:
    try:
        keys = tomllib.loads(path.read_text(encoding="utf-8")).keys()
    except (OSError, ValueError):
        return None  # what reads the file says why
    return next((kind for kind, own in KEYS.items() if own & keys), None)


def _policies_for(task: str) -> str:
    """A hint at the policies of a task: the run that it belongs to, a run that is named after it, or one that ships."""
    folder, name = Path(task).parent, Path(task).stem
    if os.path.isfile(task) and is_run(folder):
        return f"Did you mean its run, {folder}? "
    found = [each for each in _shipped("runs/policies") if each == f"{name}-refined" and "@" not in each]
    found += [
        f"runs/{each}" for each in _entries(Path("runs")) if each.startswith(f"{name}-") and is_run(f"runs/{each}")
    ]
    return f"Did you mean {' or '.join(found[:MOST])}? " if found else ""


def _shipped(folder: str) -> list[str]:
    """The names of the data files in a folder of the package; a policy by the default trainer is called by its task."""
    home = resources.files("flytune") / folder
    stems = [each.name.rpartition(".")[0] for each in home.iterdir()] if home.is_dir() else []
    return sorted({stem.removesuffix("@apg") for stem in stems if stem})


def _entries(folder: Path) -> list[str]:
    try:
        return sorted(os.listdir(folder))
    except OSError:
        return []
