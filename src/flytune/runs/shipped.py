"""Policies that ship with flytune: they fly without any training."""

from importlib import resources
from pathlib import Path

DEFAULT_TRAINER = "apg"  # whose policy a bare name means
HOME = resources.files("flytune.runs") / "policies"


def shipped_names() -> list[str]:
    """Who flies without a training: `TASK` for the policy of the analytic gradient, `TASK@TRAINER` for another."""
    entries = sorted(entry.name for entry in HOME.iterdir()) if HOME.is_dir() else []
    stems = [name.removesuffix(".safetensors") for name in entries if name.endswith(".safetensors")]
    return [stem.removesuffix(f"@{DEFAULT_TRAINER}") for stem in stems]


def shipped_files(name: str) -> tuple[Path, Path]:
    """Where the policy of a shipped name is, and the run.json of its training beside it."""
    stem = name if "@" in name else f"{name}@{DEFAULT_TRAINER}"
    folder = Path(str(HOME))
    return folder / f"{stem}.safetensors", folder / f"{stem}.json"
