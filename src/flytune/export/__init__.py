"""Policies for use outside flytune, and readers of policies that were made elsewhere."""

from pathlib import Path
from typing import Any, Literal

from flytune.errors import BadInput


def export_policy(policy: Any, path: str | Path, format: Literal["onnx", "safetensors"] = "onnx") -> Path:
    """Write a policy for use outside flytune; returns the path of the file.

    Args:
        policy: a learned policy, for instance `run.policy`, or what `find_controller` returns for one.
        path: the file to write; its folder has to exist, and a file that is there is replaced.
        format: `onnx`, which any ONNX runtime can run, or `safetensors`, flytune's own format.

    Raises:
        BadInput: the format is unknown, the controller has no weights to write (a classical controller, a policy from
            an ONNX file), the extra that the format needs is missing, or the file cannot be written.
    """
    from flytune.control.policy import Policy, save_policy
    from flytune.export.onnx import save_onnx

    writers = {"onnx": save_onnx, "safetensors": save_policy}
    if format not in writers:
        raise BadInput(f"format: {format!r} is unknown. Allowed: {', '.join(writers)}.")
    learned = getattr(policy, "controller", policy)
    if not isinstance(learned, Policy):
        name = getattr(policy, "name", type(learned).__name__)
        raise BadInput(
            f"{name}: cannot be exported. Allowed: a policy with its weights, from a training, a run directory, "
            "a .safetensors file, a .zip of Stable-Baselines3, or one that ships."
        )
    writers[format](Path(path), learned)
    return Path(path)
