"""The trainings of a study, side by side on the free cores, each in a process of its own."""

import contextlib
import json
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable
from concurrent.futures import FIRST_EXCEPTION, ThreadPoolExecutor, wait
from pathlib import Path
from typing import Any

from flytune.config.files import write_text
from flytune.errors import BadInput, Diverged, Interrupted
from flytune.reproduction.study import BEHAVIOURS, Study, Training, training_status
from flytune.task.files import write_task
from flytune.training.loop import Progress
from flytune.training.threads import CORES, cores, free_cores

ATTEMPTS = 3  # of one training whose process was killed


def train_all(
    study: Study,
    *,
    on_progress: Callable[[Training, Progress], None],
    on_message: Callable[[str], None],
    workers: int | None = None,
) -> None:
    """Train everything of the study that is not trained yet.

    A training whose process is killed continues from its checkpoint, or begins again. Its result is the same either
    way, bit by bit.

    Args:
        study: what to train.
        on_progress: called from several threads, a few times a second per training.
        on_message: called with a line for the user.
        workers: processes side by side; one per free core where None.

    Raises:
        BadInput: a directory holds something else, or a training refused its input.
        Diverged: the numbers of a training stopped being finite; the other trainings under way were finished.
        Interrupted: Ctrl-C, every training under way saved a checkpoint; or a process was killed again and again.
    """
    status = {training: training_status(study, training, on_message) for training in study.trainings()}
    unfinished = [training for training in status if status[training] != "finished"]
    if len(unfinished) < len(status):
        on_message(f"{len(status) - len(unfinished)} of {len(status)} trainings were done before")
    number = workers or free_cores()
    processes = _Processes(study, on_progress, on_message, max(1, cores() // number))
    with ThreadPoolExecutor(number) as pool:
        futures = [pool.submit(processes.train, training, status[training] == "interrupted") for training in unfinished]
        try:
            wait(futures, return_when=FIRST_EXCEPTION)
            for future in futures:
                if future.done():
                    future.result()
        except BaseException as error:
            for future in futures:
                future.cancel()
            if not isinstance(error, Diverged):
                processes.interrupt()
            pool.shutdown(wait=True)
            if isinstance(error, KeyboardInterrupt):
                raise Interrupted(
                    f"interrupted; every training is kept in {study.folder}. Continue with the same command."
                ) from None
            raise


class _Processes:
    """The processes under way, so that all of them can be told to stop."""

    def __init__(
        self,
        study: Study,
        on_progress: Callable[[Training, Progress], None],
        on_message: Callable[[str], None],
        cores_each: int,
    ) -> None:
        """Write the task files that the processes read."""
        self.study, self.on_progress, self.on_message = study, on_progress, on_message
        self.environment = {**os.environ, CORES: str(cores_each)}
        self.tasks = {behaviour: study.folder / f"{study.preset(behaviour)}.toml" for behaviour in BEHAVIOURS}
        for behaviour, path in self.tasks.items():
            write_text(path, write_task(study.task(behaviour)))
        self.running: set[subprocess.Popen[str]] = set()
        self.stopped = False
        self.lock = threading.Lock()

    def interrupt(self) -> None:
        """Ask every process to save a checkpoint and to end."""
        with self.lock:
            self.stopped = True
            for process in self.running:
                with contextlib.suppress(ProcessLookupError):
                    process.send_signal(signal.SIGINT)

    def train(self, training: Training, resume: bool) -> None:
        """Run one training to its end; a process that is killed is started again."""
        name = training.directory.name
        for attempt in range(1, ATTEMPTS + 1):
            code, error = self._run(training, resume)
            if code == 0 or self.stopped:
                return
            if code == 3:
                raise Diverged(f"{name}: {error}")
            if code == 2:
                raise BadInput(f"{name}: {error}")
            ended = f"{name}: its process ended with {code} {error}".rstrip()
            if attempt == ATTEMPTS:
                raise Interrupted(f"{ended}, {ATTEMPTS} times. The machine may lack memory, for instance.")
            self.on_message(f"{ended}; it is started again")
            resume = training_status(self.study, training, self.on_message) == "interrupted"

    def _run(self, training: Training, resume: bool) -> tuple[int, str]:
        """Exit code and last line of the standard error of one process."""
        order = {
            "task": str(self.tasks[training.behaviour]),
            "trainer": self.study.trainer,
            "seed": training.seed,
            "out": str(training.directory),
            "resume": resume,
        }
        with self.lock:
            if self.stopped:
                return 130, ""
            # a session of its own: Ctrl-C reaches only us, and we ask each process once for a checkpoint
            process = subprocess.Popen(
                [sys.executable, "-m", "flytune.reproduction.worker", json.dumps(order)],
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                env=self.environment,
                text=True,
                start_new_session=True,
            )
            self.running.add(process)
        assert process.stdout is not None and process.stderr is not None
        errors: list[str] = []
        listener = threading.Thread(target=lambda: errors.extend(process.stderr or []), daemon=True)
        listener.start()
        for line in process.stdout:
            self.on_progress(training, Progress(**json.loads(line)))
        code = process.wait()
        listener.join()
        with self.lock:
            self.running.discard(process)
        return code, next((line.strip() for line in reversed(errors) if line.strip()), "")


@contextlib.contextmanager
def show_trainings(number: int, stream: Any = sys.stderr) -> Any:
    """`on_progress` and `on_message` for so many trainings: a bar per training under way and one for all of them."""
    from rich.console import Console
    from rich.progress import BarColumn, TextColumn, TimeElapsedColumn
    from rich.progress import Progress as Bars

    console = Console(file=stream)
    shares: dict[Path, float] = {}
    lock = threading.Lock()
    columns = (TextColumn("{task.description}"), BarColumn(24), TextColumn("{task.fields[text]}"), TimeElapsedColumn())
    with Bars(*columns, console=console, disable=not console.is_terminal) as bars:
        total = bars.add_task(f"{number} trainings", total=number, text="")
        rows: dict[Path, Any] = {}

        def on_progress(training: Training, progress: Progress) -> None:
            name, share = training.directory, progress.update / progress.updates
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

        def on_message(line: str) -> None:
            with lock:
                bars.console.print(line, highlight=False, soft_wrap=True)

        yield on_progress, on_message
