"""Optional packages: imported where they are needed, and named with their remedy where they are missing."""

from importlib import import_module
from types import ModuleType

from flytune.errors import BadInput


def require(package: str, extra: str) -> ModuleType:
    """The module of an optional package.

    Args:
        package: what to import, for instance `onnxruntime`.
        extra: the extra of flytune that brings it, for instance `onnx`.

    Raises:
        BadInput: it is not installed; the line names the command that installs it.
    """
    try:
        return import_module(package)
    except ModuleNotFoundError as error:
        if error.name != package.partition(".")[0]:
            raise  # the package is there and lacks something of its own
        raise BadInput(f'{package}: is not installed. Install it with: pip install "flytune[{extra}]"') from None
