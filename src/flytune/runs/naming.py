"""The names of run directories that the user did not name; a name is taken by making its directory."""

import contextlib
import hashlib
import json
import os
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from flytune.errors import BadInput


def run_name(name: str, changes: Mapping[str, Any]) -> str:
    """The name of a run: six digits behind it stand for the settings that were changed, so that none are hidden."""
    name = re.sub(r"[^\w.-]+", "-", name).strip(".-") or "run"  # a task may have any name, "../mine" too
    if not changes:
        return name
    text = json.dumps(changes, sort_keys=True, default=str)
    return f"{name}-{hashlib.sha256(text.encode()).hexdigest()[:6]}"


@contextlib.contextmanager
def new_directory(name: str) -> Iterator[Path]:
    """A new directory under `runs`: `name`, with a number behind it where that is taken, also by a process just now.

    It is removed again if nothing was written into it.

    Raises:
        BadInput: it cannot be made.
    """
    folder = Path("runs")
    path, number, vanished = folder / name, 1, 0
    made = not folder.exists()
    while True:
        try:
            path.mkdir(parents=True)
            break
        except OSError as error:
            if os.path.lexists(path):
                number += 1
                path = folder / f"{name}-{number}"
                continue
            vanished += 1  # another process removes `runs`, which it left empty, between two steps of mkdir
            if not isinstance(error, FileNotFoundError | FileExistsError) or vanished > 100:
                raise BadInput(f"out: {path} cannot be written ({error.strerror}). Give --out DIR.") from None
    try:
        yield path
    finally:
        for each in (path, folder) if made else (path,):
            with contextlib.suppress(OSError):  # what holds something stays
                each.rmdir()
