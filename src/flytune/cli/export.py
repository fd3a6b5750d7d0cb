"""`flytune export`."""

from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter

from flytune.cli.completion import controllers
from flytune.config.files import check_file

PolicyName = Annotated[
    str,
    Parameter(
        name="CONTROLLER",
        help="a run directory, a policy file (.safetensors, .onnx, .zip), or a policy that ships; with a setting of "
        "its dials (dial@speed=0.5), the policy of this setting alone",
        completer=controllers,
    ),
]
Format = Annotated[
    Literal["onnx", "safetensors"],
    Parameter(name="--format", help="onnx: for any runtime; safetensors: flytune's own format, for instance of a .zip"),
]
File = Annotated[Path, Parameter(name="--out", metavar="PATH", help="the file")]


def export(controller: PolicyName, /, *, file_format: Format, out: File) -> None:
    """Write a policy for use outside flytune."""
    from flytune.control.policy import FORMAT as SAFETENSORS
    from flytune.export import export_policy
    from flytune.export.onnx import FORMAT_VALUE as ONNX
    from flytune.runs.find import find_controller, split_setting

    mark = {"onnx": ONNX, "safetensors": SAFETENSORS}[file_format].encode()
    check_file(out, mark=mark, kind="a policy", suffixes=[f".{file_format}"])
    found = find_controller(controller)
    _, setting = split_setting(controller)
    print(export_policy(found.fixed() if setting else found, out, file_format))
