"""Files that are whole or absent: the one place where flytune writes text, bytes and JSON."""

import contextlib
import fcntl
import json
import os
import threading
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from flytune.errors import BadInput

RUN_FILES = (  # of a run directory, and of a tuning
    "task.toml", "run.json", "policy.safetensors", "policy-last.safetensors", "metrics.jsonl", "evaluation.json",
    "tune.json",
)  # fmt: skip
MARGIN = 1 << 18  # bytes of a file that are searched for a mark, at either end


def write_bytes(path: Path, content: bytes, field: str = "out") -> None:
    """Write a file, whole or not at all: a temporary file beside it takes its place once it is complete.

    A symbolic link stays, and its file is replaced. What is no file, such as /dev/null, is written to.

    Raises:
        BadInput: the file cannot be written; nothing of it is left, and an earlier file is untouched. The message
            names `field`, the option or argument that gave the path.
    """
    place = Path(os.path.realpath(path)) if os.path.islink(path) else path
    temporary = place.with_name(f"{place.name}.{os.getpid()}-{threading.get_ident()}.part")
    try:
        if _is_special(place):
            place.write_bytes(content)
            return
        temporary.write_bytes(content)
        temporary.replace(place)
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


@contextlib.contextmanager
def held(path: Path, field: str = "out") -> Iterator[None]:
    """Hold a folder that exists, so that no other process writes into it; the end of the process frees it in any case.

    Raises:
        BadInput: another process holds it.
    """
    descriptor = os.open(path, os.O_RDONLY)
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise BadInput(
                f"{field}: {path} is being written by another process. Give another directory, or wait for its end."
            ) from None
        except OSError:  # some network file systems have no locks; then nothing can be said about others
            pass
        yield
    finally:
        os.close(descriptor)


def check_file(
    path: Path, field: str = "out", *, mark: bytes = b"", kind: str = "", suffixes: Sequence[str] = ()
) -> None:
    """Refuse a path that no file may be written to, before anything is computed.

    Args:
        path: the file to write.
        field: the option or argument that gave the path.
        mark: bytes at the beginning or the end of every file of this kind that flytune writes; where given, a file
            that is there and lacks them is not replaced.
        kind: what flytune writes, in words.
        suffixes: where given, another one is refused; a name without one is taken as it is.

    Raises:
        BadInput: the name says another format; or the path is a folder, its folder does not exist, it is a file of a
            run, or a file of somebody else.
    """
    place = Path(os.path.realpath(path)) if os.path.islink(path) else path
    if not os.path.isdir(place.parent):  # unlike Path.is_dir, also where the name itself is too long
        raise BadInput(f"{field}: {place.parent} is no folder. Give a file in a folder that exists.")
    if os.path.isdir(place):
        raise BadInput(f"{field}: {path} is a folder. Give a file.")
    exists = bool(mark) and os.path.exists(place) and not _is_special(place)
    if exists and place.name in RUN_FILES and os.path.exists(place.with_name("run.json")):
        raise BadInput(f"{field}: {path} is a file of a run, which is not replaced. Give another path.")
    check_suffix(path, field, kind, suffixes)
    if exists and not _is_marked(place, mark):
        raise BadInput(
            f"{field}: {path} is there and is not {kind} of flytune. Give another path, or remove this file."
        )


def check_suffix(path: Path, field: str, kind: str, suffixes: Sequence[str]) -> None:
    """Refuse a file name that says another format; one that says none is taken as it is.

    Raises:
        BadInput: it has a suffix that is not among `suffixes`, where there are any.
    """
    if suffixes and path.suffix and path.suffix.lower() not in suffixes:
        raise BadInput(
            f"{field}: {path} is not allowed. Allowed: {kind}, whose name ends in {' or '.join(suffixes)}. Did you "
            f"mean {path.with_suffix(suffixes[0])}?"
        )


def _is_marked(path: Path, mark: bytes) -> bool:
    """Whether a file is empty, or has the mark at its beginning or its end."""
    try:
        with path.open("rb") as file:
            head = file.read(MARGIN)
            file.seek(max(0, file.seek(0, os.SEEK_END) - MARGIN))
            return not head or mark in head or mark in file.read()
    except OSError:
        return False


def _is_special(path: Path) -> bool:
    """Whether a path is there and is neither a file nor a folder, such as /dev/null or a pipe."""
    return os.path.exists(path) and not os.path.isfile(path) and not os.path.isdir(path)
