"""The exceptions a user can meet, each with its exit code; and the checks of packages, which may raise one."""

import re
from functools import cache
from importlib import import_module
from importlib.util import find_spec
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


@cache
def check_installed(extra: str = "") -> None:
    """Refuse packages that are older than flytune declares: pip keeps an old one that was put in later.

    Args:
        extra: the extra of flytune whose packages are checked; "" checks those that flytune always needs.

    Raises:
        BadInput: one is too old, or one that is always needed is missing; the line names the command that mends it.
    """
    from importlib.metadata import PackageNotFoundError, requires, version  # slow, and `flytune --help` does without

    try:
        declared = requires("flytune") or []
    except PackageNotFoundError:
        return  # a bare copy of the source declares nothing
    wrong, remedy = [], []
    for line in declared:
        needed = re.fullmatch(r"([\w.-]+)>=([\d.]+)(?:; extra == [\"'](\w+)[\"'])?", line)
        if needed is None or (needed[3] or "") != extra:
            continue
        name, lowest = needed[1], needed[2]
        try:
            found = version(name)
        except PackageNotFoundError:
            if extra or find_spec(name.replace("-", "_")):
                continue  # `require` says which optional package is missing; and some are installed without metadata
            wrong.append(f"{name} is not installed")
        else:
            if _release(found) >= _release(lowest):
                continue
            wrong.append(f"{name} {found} is too old, {lowest} or newer is needed")
        remedy.append(f'"{name}>={lowest}"')
    if wrong:
        raise BadInput(f"{'; '.join(wrong)}. Install with: pip install {' '.join(remedy)}")


def _release(version: str) -> tuple[int, ...]:
    """The numbers of a version to compare by: (2, 13) for 2.13.0+cpu and for 2.13.0rc1."""
    numbers = [int(number) for number in re.match(r"[\d.]*", version)[0].split(".") if number]  # pyright: ignore
    while numbers and numbers[-1] == 0:
        numbers.pop()
    return tuple(numbers)


def require(package: str, extra: str) -> ModuleType:
    """The module of an optional package.

    Args:
        package: what to import, for instance `onnxruntime`.
        extra: the extra of flytune that brings it, for instance `onnx`.

    Raises:
        BadInput: it is not installed or too old; the line names the command that installs it.
    """
    check_installed()
    check_installed(extra)
    try:
        return import_module(package)
    except ModuleNotFoundError as error:
        if error.name != package.partition(".")[0]:
            raise  # the package is there and lacks something of its own
        raise BadInput(f'{package}: is not installed. Install it with: pip install "flytune[{extra}]"') from None
