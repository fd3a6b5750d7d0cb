"""`flytune export`."""

from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter

from flytune.config.files import check_file
from flytune.errors import BadInput

PolicyName = Annotated[
    str,
    Parameter(
        name="CONTROLLER", help="a run directory, a policy file (.safetensors, .onnx, .zip), or a policy that ships"
    ),
]
Format = Annotated[
    Literal["onnx", "safetensors"],
    Parameter(name="--format", help="onnx: for any runtime; safetensors: flytune's own format, for instance of a .zip"),
]
File = Annotated[Path, Parameter(name="--out", metavar="PATH", help="the file")]


def export(controller: PolicyName, /, *, file_format: Format, out: File) -> None:
    """Write a policy for use outside flytune."""
    from flytune.control.policy import Policy, save_policy
    from flytune.export.onnx import save_onnx
    from flytune.runs.find import find_controller

    check_file(out)
    policy = find_controller(controller).controller
    if not isinstance(policy, Policy):
        raise BadInput(f"{controller}: is not a policy of flytune. Allowed: a run directory, .safetensors, .zip.")
    {"onnx": save_onnx, "safetensors": save_policy}[file_format](out, policy)
    print(out)
