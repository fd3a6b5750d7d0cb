"""The journal of a tuning, tune.json: what was asked, every step, every verdict; an interruption loses none of them."""

import dataclasses
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from flytune.config.files import make_folder, write_json
from flytune.errors import BadInput
from flytune.tuning.iteration import Step
from flytune.tuning.result import Verdict


def write_journal(
    directory: Path,
    asked: Mapping[str, Any],
    steps: Sequence[Step],
    verdicts: Sequence[Verdict],
    about: Mapping[str, Any],
) -> None:
    """Write everything so far, whole or not at all.

    Raises:
        BadInput: the directory cannot be written.
    """
    told = {
        "schema": 1, **asked, **about, "steps": [step.to_dict() for step in steps],
        "verdicts": [dataclasses.asdict(verdict) for verdict in verdicts],
    }  # fmt: skip
    make_folder(directory)
    write_json(directory / "tune.json", told)


def read_journal(directory: Path, asked: Mapping[str, Any]) -> tuple[list[Step], list[Verdict]]:
    """The steps and verdicts of a tuning that was asked for the same.

    Raises:
        BadInput: there is no journal, it is damaged, or something else was asked.
    """
    path = directory / "tune.json"
    try:
        told = json.loads(path.read_text(encoding="utf-8"))
        steps = [Step.from_dict(each) for each in told["steps"]]
        verdicts = [Verdict(**each) for each in told["verdicts"]]
        before = {name: told[name] for name in asked}
    except OSError:
        raise BadInput(f"resume: {directory} holds no tuning. Leave out --resume to start one.") from None
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise BadInput(f"resume: {path} is damaged ({error}). Tune again into another directory.") from None
    now = json.loads(json.dumps(asked))
    changed = ["task" if name == "tables" else name for name in now if now[name] != before[name]]
    if changed:
        raise BadInput(f"resume: {directory} was asked for another {changed[0]}. Give the same, or another directory.")
    return steps, verdicts
