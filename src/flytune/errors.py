"""The exceptions a user can meet, each with its exit code; and the import of optional packages, which may raise one."""

from importlib import import_module
from types import ModuleType


class FlytuneError(Exception):
    """Base of every error flytune raises on purpose; its text is one line for the user."""

    exit_code = 1


class BadInput(FlytuneError, ValueError):
    """What the user gave cannot be used; the text names the field, the value, what is allowed and the remedy."""

    exit_code = 2


class Diverged(FlytuneError, ArithmeticError):
    """Numbers stopped being finite, in training or in a controller; the text says what, where and when."""

    exit_code = 3


class Unmet(FlytuneError):
    """A tuning ended without meeting its requirement; the text says what is missing and why nothing could help."""

    exit_code = 4


class Interrupted(FlytuneError):
    """The user stopped a training; the text names the checkpoint that was saved."""

    exit_code = 130


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
