"""The trainings of a study, side by side on the free cores, each in a process of its own."""

import contextlib
import json
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_EXCEPTION, ThreadPoolExecutor, wait
from pathlib import Path
from typing import Any

from flytune.config.files import write_text
from flytune.errors import BadInput, Diverged, Interrupted
from flytune.reproduction.study import Member, Study, condition
from flytune.task.task import write_task
from flytune.training.loop import Progress

ATTEMPTS = 3  # of one training whose process was killed


def free_cores() -> int:
    """How many cores this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def train_all(
    study: Study,
    *,
    on_progress: Callable[[Member, Progress], None],
    tell: Callable[[str], None],
    workers: int | None = None,
) -> None:
    """Train whatever of the study is not trained yet.

    A training whose process is killed goes on from its checkpoint, or begins again; either way its result is the same
    bit by bit.

    Args:
        study: what to train.
        on_progress: called from several threads, a few times a second per training.
        tell: called with a line for the user.
        workers: processes side by side; one per free core where None.

    Raises:
        BadInput: a directory holds something else, or a training refused its input.
        Diverged: the numbers of a training stopped being finite; those under way were finished.
        Interrupted: Ctrl-C, every training under way saved a checkpoint; or a process was killed again and again.
    """
    conditions = [(member, condition(study, member, tell)) for member in study.members()]
    open_ones = [(member, state) for member, state in conditions if state != "done"]
    if len(open_ones) < len(conditions):
        tell(f"{len(conditions) - len(open_ones)} of {len(conditions)} trainings were done before")
    tasks = _write_tasks(study)
    crew = _Crew()
    with ThreadPoolExecutor(workers or free_cores()) as pool:
        futures = [
            pool.submit(crew.train, study, member, tasks[member.role], state == "begun", on_progress, tell)
            for member, state in open_ones
        ]
        try:
            wait(futures, return_when=FIRST_EXCEPTION)
            for future in futures:
                if future.done():
                    future.result()
        except BaseException as error:
            for future in futures:
                future.cancel()
            if not isinstance(error, Diverged):
                crew.interrupt()
            pool.shutdown(wait=True)
            if isinstance(error, KeyboardInterrupt):
                raise Interrupted(
                    f"interrupted; every training is kept in {study.folder}. Go on with the same command."
                ) from None
            raise


def _write_tasks(study: Study) -> dict[str, Path]:
    """The task files the workers read, by role."""
    paths = {}
    for role in {member.role for member in study.members()}:
        paths[role] = study.folder / f"{study.preset(role)}.toml"
        write_text(paths[role], write_task(study.task(role)))
    return paths


class _Crew:
    """The processes under way, so that they can all be told to stop."""

    def __init__(self) -> None:
        self.processes: set[subprocess.Popen[str]] = set()
        self.stopped = False
        self.lock = threading.Lock()

    def interrupt(self) -> None:
        """Ask every process for a checkpoint and an end."""
        with self.lock:
            self.stopped = True
            for process in self.processes:
                with contextlib.suppress(ProcessLookupError):
                    process.send_signal(signal.SIGINT)

    def train(
        self,
        study: Study,
        member: Member,
        task: Path,
        begun: bool,
        on_progress: Callable[[Member, Progress], None],
        tell: Callable[[str], None],
    ) -> None:
        """One training, from where it stands to its end."""
        for attempt in range(1, ATTEMPTS + 1):
            code, words = self._run(study, member, task, begun, on_progress)
            if code == 0 or self.stopped:
                return
            if code == 3:
                raise Diverged(f"{member.directory.name}: {words}")
            if code == 2:
                raise BadInput(f"{member.directory.name}: {words}")
            ended = f"{member.directory.name}: its process ended with {code} {words}".rstrip()
            if attempt == ATTEMPTS:
                raise Interrupted(f"{ended}, the {ATTEMPTS}. time. What it needs may be missing, memory for instance.")
            tell(f"{ended}; it goes on")
            begun = condition(study, member, tell) == "begun"

    def _run(
        self,
        study: Study,
        member: Member,
        task: Path,
        begun: bool,
        on_progress: Callable[[Member, Progress], None],
    ) -> tuple[int, str]:
        """Exit code and last words of one process."""
        order = {
            "task": str(task),
            "trainer": study.trainer,
            "seed": member.seed,
            "out": str(member.directory),
            "resume": begun,
        }
        with self.lock:
            if self.stopped:
                return 130, ""
            # a session of its own: Ctrl-C reaches only us, and we ask each process once, for a checkpoint
            process = subprocess.Popen(
                [sys.executable, "-m", "flytune.reproduction.worker", json.dumps(order)],
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                text=True,
                start_new_session=True,
            )
            self.processes.add(process)
        assert process.stdout is not None and process.stderr is not None
        words: list[str] = []
        listener = threading.Thread(target=lambda: words.extend(process.stderr or []), daemon=True)
        listener.start()
        for line in process.stdout:
            on_progress(member, Progress(**json.loads(line)))
        code = process.wait()
        listener.join()
        with self.lock:
            self.processes.discard(process)
        return code, _last(words)


def _last(words: Sequence[str]) -> str:
    lines = [line.strip() for line in words if line.strip()]
    return lines[-1] if lines else ""


@contextlib.contextmanager
def show_all(study: Study, stream: Any = sys.stderr) -> Any:
    """What to hand to `train_all` as `on_progress` and `tell`: a bar per training under way and one for all."""
    from rich.console import Console
    from rich.progress import BarColumn, TextColumn, TimeElapsedColumn
    from rich.progress import Progress as Bars

    console = Console(file=stream)
    members = study.members()
    shares: dict[Path, float] = {}
    lock = threading.Lock()
    columns = (TextColumn("{task.description}"), BarColumn(24), TextColumn("{task.fields[text]}"), TimeElapsedColumn())
    with Bars(*columns, console=console, disable=not console.is_terminal) as bars:
        total = bars.add_task(f"{len(members)} trainings", total=len(members), text="")
        rows: dict[Path, Any] = {}

        def on_progress(member: Member, progress: Progress) -> None:
            name, share = member.directory, progress.update / progress.updates
            with lock:
                if name not in rows:
                    rows[name] = bars.add_task(name.name, total=1.0, text="")
                before = shares.get(name, 0.0)
                shares[name] = share
                text = f"{progress.steps_per_second / 1000:.0f}k steps/s  reward {progress.reward:.2f}"
                bars.update(rows[name], completed=share, text=text, visible=share < 1)
                bars.update(total, completed=sum(shares.values()))
                if not console.is_terminal and int(share * 4) > int(before * 4):
                    console.print(f"{name.name}  {share:4.0%}  {text}", highlight=False, soft_wrap=True)

        def tell(line: str) -> None:
            with lock:
                bars.console.print(line, highlight=False, soft_wrap=True)

        yield on_progress, tell
