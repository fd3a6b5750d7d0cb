"""Training: the loop over updates, what it writes down, and how it is interrupted and resumed."""

import contextlib
import dataclasses
import math
import signal
import threading
import time
from collections.abc import Callable, Iterator
from importlib import metadata
from pathlib import Path
from types import ModuleType
from typing import Any

import jax
import numpy as np

from flytune.control.policy import Policy
from flytune.errors import BadInput, Diverged, Interrupted
from flytune.runs.directory import RunDirectory, resume_command
from flytune.task.task import Task, write_task
from flytune.task.termination import causes
from flytune.training import apg, ppo, sb3
from flytune.training.tensorboard import EventLog, check_tensorboard

TRAINERS: dict[str, ModuleType] = {"apg": apg, "ppo": ppo, "sb3": sb3}
CHECKPOINT_INTERVAL = 30.0  # s between checkpoints


@dataclasses.dataclass(frozen=True, kw_only=True)
class Run:
    """A training that has ended, or what its directory says of it."""

    task: Task
    trainer: str
    seed: int
    policy: Policy  # the one that is flown: weights averaged over updates
    last_policy: Policy  # the weights of the last update
    metrics: list[dict[str, Any]]  # one row per update, as in metrics.jsonl
    directory: Path | None


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


def train(
    task: Task,
    trainer: str = "apg",
    *,
    seed: int = 0,
    out: Path | None = None,
    resume: bool = False,
    initial: Policy | None = None,
    tensorboard: bool = False,
    on_progress: Callable[[Progress], None] | None = None,
) -> Run:
    """A policy trained for a task, and the way there.

    Same task, trainer, seed and machine give the same policy bit by bit, also across an interruption, where XLA runs
    single-threaded (XLA_FLAGS="--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"; the command line
    sets this).

    Args:
        task: what to learn; `task.apg` or `task.ppo` say how.
        trainer: `apg`, `ppo`, or `sb3`, which is Stable-Baselines3's PPO with the settings of `task.ppo`.
        seed: of the weights, the episodes and the noise; 0 or more.
        out: run directory to write; nothing is written where None.
        resume: go on from the checkpoint in `out`.
        initial: a policy to go on from, with trainer `apg`; new weights where None.
        tensorboard: write TensorBoard's event files beside the metrics in `out`.
        on_progress: called after every update.

    Raises:
        BadInput: an argument that cannot be used; nothing was written.
        Diverged: numbers stopped being finite.
        Interrupted: Ctrl-C; a checkpoint was saved in `out`.
    """
    if trainer not in TRAINERS:
        raise BadInput(f"trainer: {trainer!r} is not allowed. Allowed: {', '.join(TRAINERS)}.")
    if not 0 <= seed < 2**32:
        raise BadInput(f"seed: {seed} is not allowed. Allowed: a whole number, 0 to {2**32 - 1}.")
    if initial is not None and trainer != "apg":
        raise BadInput(f"initial: trainer {trainer} cannot go on from a policy. Allowed: trainer apg.")
    if trainer == "sb3":
        sb3.check_installed()
        sb3.check_settings(task.ppo)
    if tensorboard:
        check_tensorboard()
        if out is None:
            raise BadInput("tensorboard: needs out, the run directory to write its event files into.")
    settings = task.apg if trainer == "apg" else task.ppo
    teacher = TRAINERS[trainer]
    rows: list[dict[str, Any]] = []
    with _deferred_interrupt() as interrupted:
        directory = RunDirectory(out, task, trainer, seed, resume) if out is not None else None
        train_state = teacher.start(task, settings, jax.random.key(seed))
        if initial is not None:
            train_state = apg.go_on_from(task.apg, train_state, initial)
        if directory is not None and resume:
            train_state, rows = directory.resume(train_state)
        clock = _Clock(task, trainer, seed, rows)
        with EventLog(out, rows) if tensorboard and out is not None else contextlib.nullcontext() as log:

            def tell(number: int, row: dict[str, Any]) -> None:
                if log is not None:
                    log.write(row)
                if on_progress is not None:
                    on_progress(clock.progress(number, row["reward"]))

            train_state = _loop(teacher, task, settings, train_state, rows, clock, directory, interrupted, tell)
    about = _about(task, trainer, seed, rows)
    run = Run(
        task=task,
        trainer=trainer,
        seed=seed,
        policy=dataclasses.replace(teacher.policy(settings, train_state), about=about),
        last_policy=dataclasses.replace(teacher.last_policy(settings, train_state), about=about),
        metrics=rows,
        directory=out,
    )
    if directory is not None:
        directory.finish(run.policy, run.last_policy, rows[-1])
    return run


def total_updates(task: Task, trainer: str) -> int:
    """How many updates a training takes."""
    if trainer == "apg":
        return task.apg.updates
    return task.ppo.updates


def steps_per_update(task: Task, trainer: str) -> int:
    """How many environment steps one update takes."""
    if trainer == "apg":
        return task.apg.environments * task.apg.window
    return task.ppo.environments * task.ppo.rollout


def with_steps(task: Task, trainer: str, steps: int) -> Task:
    """The task with its trainer set to stop after about `steps` environment steps, rounded up to whole updates."""
    if steps < 1:
        raise BadInput(f"steps: {steps} is not allowed. Allowed: a whole number, 1 or more environment steps.")
    if trainer == "apg":
        updates = math.ceil(steps / steps_per_update(task, trainer))
        return dataclasses.replace(task, apg=dataclasses.replace(task.apg, updates=updates))
    return dataclasses.replace(task, ppo=dataclasses.replace(task.ppo, steps=steps))


class _Clock:
    """Time and speed of a training; the first update compiles, so speed is judged by the others."""

    def __init__(self, task: Task, trainer: str, seed: int, rows: list[dict[str, Any]]) -> None:
        self.trainer, self.seed = trainer, seed
        self.label = f"{task.name}  {trainer}  seed {seed}"
        self.updates, self.samples = total_updates(task, trainer), steps_per_update(task, trainer)
        self.first, self.before = len(rows), rows[-1]["seconds"] if rows else 0.0
        self.started = self.compiled = time.monotonic()

    def resume(self, path: Path) -> str:
        """What to type to go on with the run in `path`."""
        return resume_command(path, self.trainer, self.seed)

    def seconds(self, number: int) -> float:
        """Seconds of training up to the end of update `number`, which is now."""
        if number == self.first + 1:
            self.compiled = time.monotonic()
        return self.before + time.monotonic() - self.started

    def progress(self, number: int, reward: float) -> Progress:
        """How far the training is after update `number`."""
        since = self.compiled if number > self.first + 1 else self.started
        counted = max(number - self.first - 1, 1)
        rate = counted * self.samples / max(time.monotonic() - since, 1e-9)
        return Progress(
            label=self.label,
            update=number,
            updates=self.updates,
            steps=number * self.samples,
            steps_per_second=rate,
            seconds_left=(self.updates - number) * self.samples / rate,
            reward=reward,
        )


def _loop(
    teacher: ModuleType,
    task: Task,
    settings: Any,
    train_state: Any,
    rows: list[dict[str, Any]],
    clock: _Clock,
    directory: RunDirectory | None,
    interrupted: threading.Event,
    tell: Callable[[int, dict[str, Any]], None],
) -> Any:
    """The learner after all updates; `rows` grows by one per update, and `tell` hears of each."""
    names, saved = causes(task.termination), time.monotonic()
    for number in range(len(rows) + 1, clock.updates + 1):
        train_state, seen = teacher.update(task, settings, train_state)
        jax.block_until_ready(seen)
        row = _row(seen, names, number, number * clock.samples, clock.seconds(number))
        _check_finite(row)
        rows.append(row)
        tell(number, row)
        if directory is not None and (interrupted.is_set() or time.monotonic() - saved > CHECKPOINT_INTERVAL):
            directory.checkpoint(train_state, rows)
            saved = time.monotonic()
        if interrupted.is_set():
            if directory is None:
                raise KeyboardInterrupt
            raise Interrupted(
                f"interrupted after {row['steps']} environment steps; checkpoint saved in "
                f"{directory.path / 'checkpoint'}. Go on with: {clock.resume(directory.path)}"
            )
    if directory is not None:
        directory.checkpoint(train_state, rows)
    return train_state


@contextlib.contextmanager
def _deferred_interrupt() -> Iterator[threading.Event]:
    """An event that Ctrl-C sets, so that it never falls into the middle of an update; a second Ctrl-C acts at once."""
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


def _row(seen: dict[str, Any], names: list[str], update: int, steps: int, seconds: float) -> dict[str, Any]:
    values = jax.tree.map(np.asarray, seen)

    def number(value: np.ndarray) -> float | None:
        return float(value) if np.isfinite(value) else None

    row: dict[str, Any] = {"update": update, "steps": steps, "seconds": round(seconds, 3)}
    row["episode_reward"] = number(values.pop("episode_reward"))
    row["reward"] = float(values.pop("reward"))
    row["terms"] = {name: float(value) for name, value in values.pop("terms").items()}
    row["terminations"] = dict(zip(names, map(int, values.pop("terminations")), strict=True))
    row["episodes"] = int(values.pop("episodes"))
    row["episode_length"] = number(values.pop("episode_length"))
    row |= {name: float(value) for name, value in sorted(values.items())}
    return row


def _check_finite(row: dict[str, Any]) -> None:
    for name, value in row.items():
        if isinstance(value, float) and not math.isfinite(value):
            raise Diverged(
                f"training: {name} is {value} in update {row['update']} ({row['steps']} environment steps). "
                "A smaller learning_rate, or smaller weights in the reward, may help."
            )


def _about(task: Task, trainer: str, seed: int, rows: list[dict[str, Any]]) -> dict[str, Any]:
    return {
        "task": task.name,
        "vehicle": task.vehicle.name,
        "task_toml": write_task(task),
        "trainer": trainer,
        "seed": seed,
        "steps": rows[-1]["steps"] if rows else 0,
        "version": metadata.version("flytune"),
    }
