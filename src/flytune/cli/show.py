"""`flytune list` and `show`: what there is, and what a task holds."""

import json
from typing import Annotated

from cyclopts import Parameter

from flytune.cli.options import AsJson, Edits, Task, assignments


def show(
    task: Task,
    /,
    *,
    edits: Annotated[Edits, Parameter(help="print the task after these edits: reward.velocity.weight=0.08 ...")] = (),
) -> None:
    """Print a task as TOML, each number with its unit, its range and its source."""
    from flytune.task.files import load_task, write_task

    print(write_task(load_task(task, assignments(edits))), end="")


def list(*, as_json: AsJson = False) -> None:
    """Print the names that commands take: presets, vehicles, policies, controllers and simulators."""
    from flytune.runs.catalogue import catalogue, folders

    known, files = catalogue(), folders()
    if as_json:
        print(json.dumps({"schema": 1, **known}))
        return
    width = max(len(name) for names in known.values() for name in names)
    sections = (
        f"{kind}{f' (files in {files[kind]})' if kind in files else ''}\n"
        + "\n".join(f"  {name:<{width}}  {about}" for name, about in names.items())
        for kind, names in known.items()
        if names
    )
    print("\n\n".join(sections))
