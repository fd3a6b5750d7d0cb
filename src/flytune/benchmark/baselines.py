"""Throughput beside what people use today: Stable-Baselines3 and PyBullet, measured on this machine in the same run."""

# pyright: reportMissingImports=false
# PyTorch is in no pinned requirement; without it the rest is checked all the same

import contextlib
import dataclasses
import time
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import numpy as np

from flytune.errors import BadInput
from flytune.extras import require
from flytune.task.task import Task

PROCESSES = 4  # of the baseline (paper R18)
ROUNDS, LONGEST = 5, 120.0  # each round runs every contender once, so that other work on the machine slows all; s
ROLLOUT = 1024  # steps per environment and update with 4 environments; the paper's 4,096 give the same rate
STEPS = 2000  # per environment in one repetition of a simulation

PACKAGES = {"pybullet": ("pybullet", "gymnasium"), "sb3": ("torch", "stable_baselines3"), "gymnasium": ("gymnasium",)}

Repeat = Callable[[], Any]  # one repetition of a measurement
Environments = Callable[[int], contextlib.AbstractContextManager[Any]]  # so many, in a vector of SB3's kind


@dataclasses.dataclass(frozen=True, kw_only=True)
class Row:
    """One measurement; `ratio` is to the baseline, the first row of its kind."""

    what: str
    environments: int
    steps: int  # per environment in one update, or in one repetition
    processes: int  # that simulate
    steps_per_second: float | None
    ratio: float | None = None
    missing: str | None = None  # the command that installs what this needs, where it is not installed

    def line(self) -> str:
        """The measurement for a terminal."""
        shape = f"{self.environments:4} x {self.steps:<5} {self.processes} proc."
        if self.steps_per_second is None:
            return f"{self.what:38} {shape}   not installed: {self.missing}"
        ratio = "" if self.ratio is None else f"   {self.ratio:8.1f} x"
        return f"{self.what:38} {shape}   {self.steps_per_second:10,.0f} steps/s{ratio}"


@dataclasses.dataclass(frozen=True, kw_only=True)
class Contender:
    """What is to be measured: its shape as in `Row`, the extras it needs, and how it is set up."""

    what: str
    environments: int
    steps: int
    processes: int = 1
    extras: tuple[str, ...] = ()
    prepare: Callable[[], contextlib.AbstractContextManager[Repeat]]


def compare_training(task: Task, own: Repeat) -> list[Row]:
    """Training by Stable-Baselines3 on PyBullet and on our environments, and by our own PPO, whose update is `own`."""
    number, rollout = task.ppo.environments, task.ppo.rollout
    elsewhere, here = partial(_pybullet_processes, task), partial(_own_environments, task)

    def contender(what: str, environments: Environments, number: int, steps: int, **options: Any) -> Contender:
        prepare = partial(_training, task, environments, number, steps)
        return Contender(what=what, environments=number, steps=steps, prepare=prepare, **options)

    both, sb3 = ("pybullet", "sb3"), ("sb3",)
    return measure(
        [
            contender("SB3 PPO on PyBullet", elsewhere, PROCESSES, ROLLOUT, processes=PROCESSES, extras=both),
            contender("SB3 PPO on flytune", here, PROCESSES, ROLLOUT, extras=sb3),
            contender("SB3 PPO on flytune", here, number, rollout, extras=sb3),
            Contender(what="flytune PPO", environments=number, steps=rollout, prepare=lambda: _ready(own)),
        ]
    )


def compare_simulation(task: Task, own: Repeat, own_shape: tuple[int, int]) -> list[Row]:
    """Simulation in PyBullet, by our environments for other people's trainers, and compiled as a whole (`own`)."""
    width = task.ppo.environments

    def contender(what: str, number: int, prepare: Any, *extras: str, processes: int = 1) -> Contender:
        return Contender(
            what=what, environments=number, steps=STEPS, prepare=prepare, extras=extras, processes=processes
        )

    processes = partial(_stepping, partial(_pybullet_processes, task), PROCESSES)
    vector = partial(_stepping, partial(_own_environments, task), width)
    return measure(
        [
            contender("PyBullet, SubprocVecEnv", PROCESSES, processes, "pybullet", "sb3", processes=PROCESSES),
            contender("PyBullet, Gymnasium", 1, partial(_one, task, "pybullet"), "pybullet"),
            contender("PyBullet alone, no rewards", 1, partial(_alone, task), "pybullet"),
            contender("flytune, Gymnasium", 1, partial(_one, task, "flytune"), "gymnasium"),
            contender("flytune, VecEnv", width, vector, "sb3"),
            Contender(
                what="flytune, compiled",
                environments=own_shape[0],
                steps=own_shape[1],
                prepare=lambda: _ready(own),
            ),
        ]
    )


def measure(contenders: list[Contender], clock: Callable[[], float] = time.perf_counter) -> list[Row]:
    """A row for each contender: the fastest of its repetitions, and its ratio to the first.

    Args:
        contenders: what to measure, in the order of the rows.
        clock: gives the time now in seconds.
    """
    missing = [_missing(contender.extras) for contender in contenders]
    with contextlib.ExitStack() as stack:
        runs = [
            None if lacks else stack.enter_context(contender.prepare())
            for contender, lacks in zip(contenders, missing, strict=True)
        ]
        fastest = _fastest([run for run in runs if run is not None], clock)
    seconds = [fastest.pop(0) if run is not None else None for run in runs]
    rates = [
        None if time_ is None else contender.environments * contender.steps / time_
        for contender, time_ in zip(contenders, seconds, strict=True)
    ]
    return [
        Row(
            what=contender.what,
            environments=contender.environments,
            steps=contender.steps,
            processes=contender.processes,
            steps_per_second=rate,
            ratio=rate / rates[0] if rate and rates[0] else None,
            missing=lacks,
        )
        for contender, rate, lacks in zip(contenders, rates, missing, strict=True)
    ]


def _missing(extras: tuple[str, ...]) -> str | None:
    """The command that installs what of some extras is not there, or None."""
    try:
        for extra in extras:
            for package in PACKAGES[extra]:
                require(package, extra)
    except BadInput:
        return f'pip install "flytune[{",".join(extras)}]"'
    return None


def _fastest(runs: list[Repeat], clock: Callable[[], float]) -> list[float]:
    """Seconds of the fastest repetition of each, after one that is not counted."""
    for run in runs:
        run()
    best, began = [float("inf")] * len(runs), clock()
    for number in range(ROUNDS):
        if number and clock() - began > LONGEST:
            break
        for index, run in enumerate(runs):
            started = clock()
            run()
            best[index] = min(best[index], clock() - started)
    return best


def make_environment(task: Task) -> Any:
    """The baseline's environment: ours for Gymnasium with PyBullet's physics, monitored as SB3 would."""
    from stable_baselines3.common.monitor import Monitor

    from flytune.adapters.gymnasium import HoverEnv

    return Monitor(HoverEnv(task, simulator="pybullet"))


@contextlib.contextmanager
def _pybullet_processes(task: Task, number: int) -> Iterator[Any]:
    from stable_baselines3.common.vec_env import SubprocVecEnv

    environments = SubprocVecEnv([partial(make_environment, task)] * number, start_method="forkserver")
    try:
        yield environments
    finally:
        environments.close()


@contextlib.contextmanager
def _own_environments(task: Task, number: int) -> Iterator[Any]:
    from flytune.adapters.vec_env import HoverVecEnv

    yield HoverVecEnv(task, number)


@contextlib.contextmanager
def _ready(run: Repeat) -> Iterator[Repeat]:
    yield run


@contextlib.contextmanager
def _training(task: Task, environments: Environments, number: int, rollout: int) -> Iterator[Repeat]:
    """One update of Stable-Baselines3's PPO: a rollout and the task's epochs."""
    import torch

    from flytune.training.sb3 import make_model

    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # faster at this size, for the baseline too
    try:
        with environments(number) as made:
            settings = dataclasses.replace(task.ppo, environments=number, rollout=rollout)
            model = make_model(settings, made, seed=0)
            yield lambda: model.learn(number * rollout, reset_num_timesteps=False)
    finally:
        torch.set_num_threads(threads)


def _actions(*shape: int) -> np.ndarray:
    return np.random.default_rng(0).uniform(-0.3, 0.3, (STEPS, *shape, 4)).astype(np.float32)


@contextlib.contextmanager
def _stepping(environments: Environments, number: int) -> Iterator[Repeat]:
    """Steps of a vector environment."""
    actions = _actions(number)
    with environments(number) as made:
        made.reset()
        yield lambda: [made.step(action) for action in actions]


@contextlib.contextmanager
def _one(task: Task, simulator: str) -> Iterator[Repeat]:
    """Steps of one environment of Gymnasium."""
    from flytune.adapters.gymnasium import HoverEnv

    environment, actions = HoverEnv(task, simulator=simulator), _actions()
    environment.reset(seed=0)

    def run() -> None:
        for action in actions:
            _, _, terminated, truncated, _ = environment.step(action)
            if terminated or truncated:
                environment.reset()

    yield run
    environment.close()


@contextlib.contextmanager
def _alone(task: Task) -> Iterator[Repeat]:
    """Steps of PyBullet's physics, without what makes an environment of it."""
    from flytune.simulation.simulators import make_simulator

    simulator, actions = make_simulator("pybullet", task.vehicle, 1), _actions(1)

    def run() -> None:
        for action in actions:
            simulator.advance(action)
            simulator.states()

    yield run
    simulator.close()
