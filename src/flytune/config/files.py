"""Files that are whole or absent: the one place where flytune writes text, bytes and JSON."""

import contextlib
import json
import os
from pathlib import Path
from typing import Any

from flytune.errors import BadInput


def write_bytes(path: Path, content: bytes, field: str = "out") -> None:
    """Write a file, whole or not at all: a temporary file beside it takes its place once it is complete.

    Raises:
        BadInput: the file cannot be written; nothing of it is left, and an earlier file is untouched. The message
            names `field`, the option or argument that gave the path.
    """
    temporary = path.with_name(f"{path.name}.{os.getpid()}.part")
    try:
        temporary.write_bytes(content)
        temporary.replace(path)
    except OSError as error:
        raise BadInput(f"{field}: {path} cannot be written ({error.strerror}). Give another path.") from None
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)


def write_text(path: Path, text: str, field: str = "out") -> None:
    """Write a text file in UTF-8, see `write_bytes`; what is not valid Unicode, as in some file names, becomes "?"."""
    write_bytes(path, text.encode("utf-8", errors="replace"), field)


def write_json(path: Path, content: Any, field: str = "out") -> None:
    """Write a JSON file, see `write_bytes`."""
    write_text(path, json.dumps(content, indent=2) + "\n", field)


def make_folder(path: Path, field: str = "out") -> None:
    """Make a folder and those above it, where they do not exist.

    Raises:
        BadInput: the folder cannot be made.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise BadInput(f"{field}: {path} cannot be written ({error.strerror}). Give another path.") from None


def check_file(path: Path, field: str = "out") -> None:
    """Refuse a path that no file can be written to, before anything is computed.

    Raises:
        BadInput: the path is a folder, or its folder does not exist.
    """
    if not os.path.isdir(path.parent):  # unlike Path.is_dir, also where the name itself is too long
        raise BadInput(f"{field}: {path.parent} is no folder. Give a file in a folder that exists.")
    if os.path.isdir(path):
        raise BadInput(f"{field}: {path} is a folder. Give a file.")
