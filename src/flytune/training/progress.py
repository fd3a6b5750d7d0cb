"""The progress of a training: how far it is, how fast, and how that is shown on standard error."""

import contextlib
import dataclasses
import sys
import time
from collections.abc import Callable, Iterator
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, TaskProgressColumn, TextColumn
from rich.progress import Progress as Bar

from flytune.task.training_settings import TrainerSettings


@dataclasses.dataclass(frozen=True, kw_only=True)
class Progress:
    """How far a training is."""

    label: str  # task, trainer and seed
    update: int
    updates: int
    steps: int
    steps_per_second: float
    seconds_left: float
    reward: float  # mean per step


class Clock:
    """The time and the speed of a training. The first update compiles, so later updates alone give the speed.

    `rows` are the metrics of the updates before this process, where a training is resumed.
    """

    def __init__(self, label: str, settings: TrainerSettings, rows: list[dict[str, Any]]) -> None:
        self._label, self._settings = label, settings
        self._first, self._before = len(rows), rows[-1]["seconds"] if rows else 0.0
        self._started = self._compiled = time.monotonic()

    def seconds(self, update: int) -> float:
        """Seconds of training up to the end of an update, which is now."""
        now = time.monotonic()
        if update == self._first + 1:
            self._compiled = now
        return self._before + now - self._started

    def progress(self, update: int, reward: float) -> Progress:
        """How far the training is after an update."""
        since = self._compiled if update > self._first + 1 else self._started
        counted = max(update - self._first - 1, 1)
        updates, steps_per_update = self._settings.updates, self._settings.steps_per_update
        rate = counted * steps_per_update / max(time.monotonic() - since, 1e-9)
        return Progress(
            label=self._label,
            update=update,
            updates=updates,
            steps=update * steps_per_update,
            steps_per_second=rate,
            seconds_left=(updates - update) * steps_per_update / rate,
            reward=reward,
        )


@contextlib.contextmanager
def show_progress() -> Iterator[Callable[[Progress], None]]:
    """The function for `on_progress` of `train`: it draws a bar on a terminal, and prints ten lines elsewhere."""
    console = Console(stderr=True)
    if console.is_terminal:
        name, text = TextColumn("{task.description}"), TextColumn("{task.fields[text]}")
        with Bar(name, BarColumn(20), TaskProgressColumn(), text, console=console) as bar:
            # without a cache, compiling takes longest; without a message it would look like a hang
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
