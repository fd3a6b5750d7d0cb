"""Policies that ship with flytune: they fly without any training."""

from importlib import resources
from pathlib import Path

DEFAULT_TRAINER = "apg"  # whose policy a bare name means
HOME = resources.files("flytune") / "policies"


def shipped_names() -> list[str]:
    """What WHO may be without a training: `TASK` for the policy of the analytic gradient, `TASK@TRAINER` for another."""
    files = (
        sorted(entry.name for entry in HOME.iterdir() if entry.name.endswith(".safetensors")) if HOME.is_dir() else []
    )
    return [name.removesuffix(".safetensors").removesuffix(f"@{DEFAULT_TRAINER}") for name in files]


def shipped_files(name: str) -> tuple[Path, Path]:
    """Where the policy of a shipped name is, and the run.json of its training beside it."""
    stem = name if "@" in name else f"{name}@{DEFAULT_TRAINER}"
    folder = Path(str(HOME))
    return folder / f"{stem}.safetensors", folder / f"{stem}.json"
