"""Progress on standard error: a bar on a terminal, a line every tenth of the way elsewhere."""

import contextlib
import sys
from collections.abc import Callable, Iterator

from rich.console import Console
from rich.progress import BarColumn, TaskProgressColumn, TextColumn
from rich.progress import Progress as Bar

from flytune.training.loop import Progress


@contextlib.contextmanager
def show_progress() -> Iterator[Callable[[Progress], None]]:
    """What to hand to `train` as `on_progress`."""
    console = Console(stderr=True)
    if console.is_terminal:
        columns = (
            TextColumn("{task.description}"),
            BarColumn(20),
            TaskProgressColumn(),
            TextColumn("{task.fields[text]}"),
        )
        with Bar(*columns, console=console) as bar:
            # compiling takes longest where nothing is cached yet, and would otherwise look like a hang
            task = bar.add_task("compiling (once per machine and program)", total=None, text="")
            yield lambda progress: bar.update(
                task,
                description=progress.label,
                completed=progress.update,
                total=progress.updates,
                text=_text(progress),
            )
    else:
        yield _print_tenths


def _print_tenths(progress: Progress) -> None:
    tenth = progress.update * 10 // progress.updates
    if tenth > (progress.update - 1) * 10 // progress.updates:
        print(f"{progress.label}  {tenth * 10:3d} %  {_text(progress)}", file=sys.stderr, flush=True)


def _text(progress: Progress) -> str:
    left = round(progress.seconds_left)
    return (
        f"{progress.steps:.2g} steps  {progress.steps_per_second / 1000:.0f}k/s  reward {progress.reward:.2f}  "
        f"{left // 3600}:{left // 60 % 60:02d}:{left % 60:02d} left"
    )
