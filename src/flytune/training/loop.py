"""Training: the loop over updates, what it writes, and how it is interrupted and resumed."""

import contextlib
import dataclasses
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from importlib import metadata
from pathlib import Path
from typing import Any

import jax

from flytune.config.files import held, make_folder
from flytune.control.policy import Policy, facts_of_vehicle
from flytune.errors import BadInput, Interrupted, require
from flytune.runs.directory import RunDirectory, resume_command
from flytune.task.files import write_task
from flytune.task.task import Task
from flytune.training.progress import Clock, Progress
from flytune.training.tensorboard import EventLog
from flytune.training.trainer import DEFAULT_TRAINER, find_trainer
from flytune.training.update import metrics_row
from flytune.training.warm_start import WarmStart, as_warm_start, check_ended

CHECKPOINT_INTERVAL = 30.0  # s between checkpoints


@dataclasses.dataclass(frozen=True, kw_only=True)
class Run:
    """A training that has ended."""

    task: Task
    trainer: str
    seed: int
    policy: Policy  # of the moving average of the weights
    last_policy: Policy  # the weights of the last update
    metrics: list[dict[str, Any]]  # one row per update, as in metrics.jsonl
    directory: Path | None

    def __repr__(self) -> str:
        where = f", in {self.directory}" if self.directory is not None else ""
        return f"Run({self.task.name}, {self.trainer}, seed {self.seed}, {len(self.metrics)} updates{where})"


def train(
    task: Task,
    trainer: str = DEFAULT_TRAINER,
    *,
    seed: int = 0,
    out: Path | None = None,
    resume: bool = False,
    warm_start: str | Policy | WarmStart | None = None,
    tensorboard: bool = False,
    on_progress: Callable[[Progress], None] | None = None,
) -> Run:
    """A policy trained for a task, with the metrics of its training.

    The same task, trainer, seed and machine give the same policy bit by bit, also with an interruption, where XLA runs
    on a single thread (XLA_FLAGS="--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"; the command line
    sets this).

    Args:
        task: also holds the settings of the trainer.
        trainer: the name of one of `TRAINERS`: `apg`, `ppo` or `sb3`.
        seed: of the weights, the episodes and the noise; 0 or more.
        out: run directory to write; nothing is written where None.
        resume: continue from the checkpoint in `out`.
        warm_start: a policy to start from, or the name of one (a run directory, a file, a policy that ships), for a
            trainer that supports it (`apg`, `ppo`); new weights where None. The name of a run of `ppo` also gives its
            critic to `ppo`.
        tensorboard: write TensorBoard's event files beside the metrics in `out`.
        on_progress: called after every update.

    Raises:
        BadInput: an argument that cannot be used; nothing was written.
        Diverged: numbers stopped being finite.
        Interrupted: Ctrl-C; a checkpoint was saved in `out`.
    """
    method = find_trainer(trainer)
    if not 0 <= seed < 2**32:
        raise BadInput(f"seed: {seed} is not allowed. Allowed: a whole number, 0 to {2**32 - 1}.")
    start = None if warm_start is None else as_warm_start(warm_start)
    if start is not None:
        method.check_warm_start(task, start.policy, start.field)
    method.check(task)
    if resume and out is not None:
        check_ended(out, task, trainer, seed)
    if tensorboard:
        require("tensorboard", "tensorboard")
        if out is None:
            raise BadInput("tensorboard: needs out, the run directory to write its event files into.")

    with _deferred_interrupt() as interrupted, _held(out, resume):
        facts = None if start is None else start.facts
        directory = RunDirectory(out, task, trainer, seed, resume, method.packages, facts) if out is not None else None
        train_state, rows = method.start(task, jax.random.key(seed)), []
        if start is not None:
            train_state = method.warm_start(task, train_state, start.policy, start.critic)
        if directory is not None and resume:
            train_state, rows = directory.resume(train_state)
        settings = method.settings_at_rate(task)
        clock = Clock(f"{task.name}  {trainer}  seed {seed}", settings, rows)
        saved = time.monotonic()
        with EventLog(out, rows) if tensorboard and out is not None else contextlib.nullcontext() as log:
            for update in range(len(rows) + 1, settings.updates + 1):
                train_state, measured = method.update(task, train_state)
                jax.block_until_ready(measured)
                steps = update * settings.steps_per_update
                row = metrics_row(task, measured, update, steps, clock.seconds(update))
                rows.append(row)
                if log is not None:
                    log.write(row)
                if on_progress is not None:
                    on_progress(clock.progress(update, row["reward"]))
                if directory is not None and (interrupted.is_set() or time.monotonic() - saved > CHECKPOINT_INTERVAL):
                    directory.checkpoint(train_state, rows)
                    saved = time.monotonic()
                if interrupted.is_set():
                    raise _interruption(directory, trainer, seed, steps)
        if directory is not None:
            directory.checkpoint(train_state, rows)

    about = {  # the facts in the header of a policy file
        "task": task.name,
        **facts_of_vehicle(task.vehicle),
        "task_toml": write_task(task),
        "trainer": trainer,
        "seed": seed,
        "steps": rows[-1]["steps"] if rows else 0,
        "version": metadata.version("flytune"),
    }
    run = Run(
        task=task,
        trainer=trainer,
        seed=seed,
        policy=dataclasses.replace(method.policy(task, train_state), about=about),
        last_policy=dataclasses.replace(method.last_policy(task, train_state), about=about),
        metrics=rows,
        directory=out,
    )
    if directory is not None:
        directory.finish(run.policy, run.last_policy, rows[-1])
    return run


def _held(out: Path | None, resume: bool) -> contextlib.AbstractContextManager[None]:
    """Holds a run directory, which may be new; what cannot be one is left to `RunDirectory` to refuse."""
    if out is None or (not os.path.isdir(out) and (resume or os.path.lexists(out))):
        return contextlib.nullcontext()
    make_folder(out)
    return held(out)


@contextlib.contextmanager
def _deferred_interrupt() -> Iterator[threading.Event]:
    """An event that Ctrl-C sets, so that no update is cut in two; a second Ctrl-C acts at once."""
    event = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield event
        return
    usual = signal.getsignal(signal.SIGINT)

    def once(number: int, frame: object) -> None:
        event.set()
        signal.signal(signal.SIGINT, usual)

    signal.signal(signal.SIGINT, once)
    try:
        yield event
    finally:
        signal.signal(signal.SIGINT, usual)


def _interruption(directory: RunDirectory | None, trainer: str, seed: int, steps: int) -> BaseException:
    """The exception of an interrupted training; it names the checkpoint, where there is one."""
    if directory is None:
        return KeyboardInterrupt()
    return Interrupted(
        f"interrupted after {steps} environment steps; checkpoint saved in {directory.path / 'checkpoint'}. "
        f"Continue with: {resume_command(directory.path, trainer, seed)}"
    )
