"""What can be named: presets, vehicles, policies that ship, controllers and simulators, with a line each."""

import json
from importlib import resources
from pathlib import Path
from typing import Any

from flytune.physics.vehicle import vehicle_names
from flytune.runs.shipped import shipped_files, shipped_names
from flytune.simulation.simulators import SIMULATORS
from flytune.task.files import preset_names


def catalogue() -> dict[str, dict[str, str]]:
    """Kind -> name -> one line about it; the kinds are those of `flytune list`."""
    gains = resources.files("flytune.control") / "gains"
    classical = sorted(entry.name.removesuffix(".toml") for entry in gains.iterdir() if entry.name.endswith(".toml"))
    return {
        "presets": {name: _first_sentence("flytune.task", "presets", name) for name in preset_names()},
        "vehicles": {name: _first_sentence("flytune.physics", "vehicles", name) for name in vehicle_names()},
        "conditions": {},
        "policies": {name: _training(name) for name in shipped_names()},
        "controllers": {name: _first_sentence("flytune.control", "gains", name) for name in classical},
        "simulators": SIMULATORS,
    }


def folders() -> dict[str, Path]:
    """Kind -> the folder of the files that ship, of those kinds whose files are worth a copy."""
    return {
        "presets": Path(str(resources.files("flytune.task") / "presets")),
        "vehicles": Path(str(resources.files("flytune.physics") / "vehicles")),
    }


def _first_sentence(package: str, folder: str, name: str) -> str:
    """The first sentence of the comment with which a file begins."""
    file = resources.files(package) / folder / f"{name}.toml"
    comment = file.read_text(encoding="utf-8").partition("\n")[0].removeprefix("# ")
    return comment.split(". ")[0].removesuffix(".") + "."


def _training(name: str) -> str:
    """How a policy that ships was trained."""
    facts: dict[str, Any] = json.loads(shipped_files(name)[1].read_text(encoding="utf-8"))
    return (
        f"Trained by {facts['trainer']} for task {facts['task']}, seed {facts['seed']}: "
        f"{facts['steps'] / 1e6:.3g} million steps in {facts['seconds']:.0f} s."
    )
