"""`flytune show`."""

from flytune.cli.options import Task


def show(task: Task, /) -> None:
    """Print a task as TOML, each number with its unit, its range and its source."""
    from flytune.task.files import load_task, write_task

    print(write_task(load_task(task)), end="")
