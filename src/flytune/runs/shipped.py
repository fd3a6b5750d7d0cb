"""Policies that ship with flytune: they fly without any training."""

from importlib import resources
from pathlib import Path

DEFAULT_TRAINER = "apg"  # of a training, and of the policy that a name without a trainer means
HOME = resources.files("flytune.runs") / "policies"


def shipped_names() -> list[str]:
    """The names of the policies that ship, see `shipped_name`."""
    entries = sorted(entry.name for entry in HOME.iterdir()) if HOME.is_dir() else []
    stems = [name.removesuffix(".safetensors") for name in entries if name.endswith(".safetensors")]
    return [stem.removesuffix(f"@{DEFAULT_TRAINER}") for stem in stems]


def shipped_name(task: str, trainer: str) -> str:
    """The name of the policy that a trainer learned for a task: `TASK`, or `TASK@TRAINER` unless it is the default."""
    return task if trainer == DEFAULT_TRAINER else f"{task}@{trainer}"


def shipped_files(name: str) -> tuple[Path, Path]:
    """The file of a policy that ships, and the run.json of its training."""
    stem = name if "@" in name else f"{name}@{DEFAULT_TRAINER}"
    folder = Path(str(HOME))
    return folder / f"{stem}.safetensors", folder / f"{stem}.json"
