"""XML of other programs, read without what makes XML dangerous: no DOCTYPE, no entities, no size without limit."""

import math
import re
from pathlib import Path
from xml.etree import ElementTree

from flytune.errors import BadInput

LARGEST = 4 << 20  # bytes; models of vehicles have a few thousand lines
ROOTS = {"robot": "URDF", "sdf": "SDF", "mujoco": "MJCF"}
Element = ElementTree.Element


def parse(path: Path) -> Element:
    """The root element of an XML file.

    Raises:
        BadInput: it cannot be read, is too large, has a DOCTYPE or entities, is a template, or is not XML.
    """
    text = _text(path)
    if re.search(r"<!(DOCTYPE|ENTITY)", text, re.IGNORECASE):
        raise BadInput(f"{path}: has a DOCTYPE or entities, which are not read. Remove them.")
    if "{%" in text:
        raise BadInput(f"{path}: is a template of jinja. Give the file that it makes, for PX4 with its jinja_gen.py.")
    try:
        root = ElementTree.fromstring(text)
    except (ElementTree.ParseError, ValueError) as error:
        raise BadInput(f"{path}: is not valid XML: {error}.") from None
    if any("ros.org/wiki/xacro}" in str(each.tag) for each in root.iter()):
        raise BadInput(f"{path}: is a template of xacro. Give the file that it makes: xacro {path.name} > model.urdf")
    return root


def short_name(path: Path) -> str:
    """The name of a file in messages and sources; with its folder where it says nothing alone, as model.sdf."""
    return f"{path.resolve().parent.name}/{path.name}" if path.stem in ("model", "scene") else path.name


def _text(path: Path) -> str:
    try:
        size = path.stat().st_size
        if size > LARGEST:
            raise BadInput(f"{path}: has {size} bytes. Allowed: {LARGEST} or less. Give the model of one vehicle.")
        return path.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise BadInput(f"{path}: cannot be read ({error.strerror}). Give a file of a vehicle.") from None
    except UnicodeDecodeError:
        raise BadInput(f"{path}: is not text in UTF-8. Give a URDF, SDF or MJCF file.") from None


def number(text: str | None, where: str) -> float:
    """A finite number.

    Raises:
        BadInput: the text is none; the line begins with `where`.
    """
    try:
        value = float(text or "")
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise BadInput(f"{where}: {(text or '').strip()[:40]!r} is not allowed. Allowed: a finite number.")
    return value


def numbers(text: str | None, count: int, where: str) -> list[float]:
    """Numbers with spaces between them.

    Raises:
        BadInput: they are not `count` finite numbers.
    """
    parts = (text or "").split()
    if len(parts) != count:
        raise BadInput(f"{where}: {(text or '').strip()[:60]!r} is not allowed. Allowed: {count} numbers.")
    return [number(part, where) for part in parts]
