"""The throughput of the usual software, Stable-Baselines3 and PyBullet, measured on this machine beside flytune's."""

# pyright: reportMissingImports=false
# PyTorch is in no pinned requirement; without it the rest is checked all the same

import contextlib
import dataclasses
import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any

import numpy as np

from flytune.errors import BadInput, require
from flytune.tables import NULL, Column, Table
from flytune.task.task import Task

PROCESSES = 4  # of the baseline (paper R18)
ROUNDS, LONGEST = 5, 120.0  # rounds and seconds at most; a round runs each case once, so that other load is shared
ROLLOUT = 1024  # steps per environment and update with 4 environments; the paper's 4,096 give the same rate
STEPS = 2000  # per environment in one repetition of a simulation

PACKAGES = {"pybullet": ("pybullet", "gymnasium"), "sb3": ("torch", "stable_baselines3"), "gymnasium": ("gymnasium",)}

Repeat = Callable[[], Any]  # one repetition of a measurement
# number -> a vector environment for Stable-Baselines3
Environments = Callable[[int], contextlib.AbstractContextManager[Any]]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Measurement:
    """The throughput of one case; `ratio` is to the first case, the baseline."""

    what: str
    environments: int
    steps: int  # per environment in one update, or in one repetition
    processes: int = 1  # simulating processes
    steps_per_second: float | None = None
    ratio: float | None = None
    missing: str | None = None  # the command that installs a missing package


@dataclasses.dataclass(frozen=True)
class Case:
    """What is to be measured, the function that prepares it, and the extras it needs."""

    measurement: Measurement  # without its rate
    prepare: Callable[[], contextlib.AbstractContextManager[Repeat]]
    extras: Sequence[str] = ()


def measurements_table(measurements: Sequence[Measurement]) -> Table:
    """The measurements as a table."""
    return Table.of(
        [
            Column("", lambda each: each.what, align="left"),
            Column("environments", lambda each: each.environments),
            Column("steps", lambda each: each.steps),
            Column("processes", lambda each: each.processes),
            Column("steps/s", lambda each: f"{each.steps_per_second:,.0f}" if each.steps_per_second else NULL),
            Column("ratio", lambda each: f"{each.ratio:.1f} x" if each.ratio else NULL),
            Column("", lambda each: f"not installed: {each.missing}" if each.missing else "", align="left"),
        ],
        measurements,
    )


def compare_training(task: Task, own: Repeat) -> list[Measurement]:
    """Training by Stable-Baselines3 on PyBullet and on flytune, and by flytune's PPO (`own`: one update)."""
    number, rollout = task.ppo.environments, task.ppo.rollout
    elsewhere, here = partial(_pybullet_processes, task), partial(_own_environments, task)

    def case(what: str, environments: Environments, number: int, steps: int, *extras: str, processes: int = 1) -> Case:
        measurement = Measurement(what=what, environments=number, steps=steps, processes=processes)
        return Case(measurement, partial(_training, task, environments, number, steps), extras)

    return measure(
        [
            case("SB3 PPO on PyBullet", elsewhere, PROCESSES, ROLLOUT, "pybullet", "sb3", processes=PROCESSES),
            case("SB3 PPO on flytune", here, PROCESSES, ROLLOUT, "sb3"),
            case("SB3 PPO on flytune", here, number, rollout, "sb3"),
            _own("flytune PPO", own, number, rollout),
        ]
    )


def compare_simulation(task: Task, own: Repeat, own_shape: tuple[int, int]) -> list[Measurement]:
    """Simulation in PyBullet, in flytune's environments for other packages, and compiled as a whole (`own`)."""
    width = task.ppo.environments

    def case(what: str, number: int, prepare: Any, *extras: str, processes: int = 1) -> Case:
        measurement = Measurement(what=what, environments=number, steps=STEPS, processes=processes)
        return Case(measurement, prepare, extras)

    processes = partial(_stepping, partial(_pybullet_processes, task), PROCESSES)
    vector = partial(_stepping, partial(_own_environments, task), width)
    return measure(
        [
            case("PyBullet, SubprocVecEnv", PROCESSES, processes, "pybullet", "sb3", processes=PROCESSES),
            case("PyBullet, Gymnasium", 1, partial(_one, task, "pybullet"), "pybullet"),
            case("PyBullet alone, no rewards", 1, partial(_alone, task), "pybullet"),
            case("flytune, Gymnasium", 1, partial(_one, task, "flytune"), "gymnasium"),
            case("flytune, VecEnv", width, vector, "sb3"),
            _own("flytune, compiled", own, *own_shape),
        ]
    )


def _own(what: str, run: Repeat, environments: int, steps: int) -> Case:
    """A case of flytune that is ready to run."""
    measurement = Measurement(what=what, environments=environments, steps=steps)
    return Case(measurement, lambda: contextlib.nullcontext(run))


def measure(cases: Sequence[Case], clock: Callable[[], float] = time.perf_counter) -> list[Measurement]:
    """The throughput of each case in the fastest of its repetitions; the clock gives the time now in seconds."""
    missing = [_missing(case.extras) for case in cases]
    with contextlib.ExitStack() as stack:
        runs = {
            index: stack.enter_context(case.prepare()) for index, case in enumerate(cases) if missing[index] is None
        }
        seconds = dict(zip(runs, fastest(list(runs.values()), clock), strict=True))
    measured = [case.measurement for case in cases]
    steps = {index: measured[index].environments * measured[index].steps for index in seconds}
    rates = {index: steps[index] / shortest for index, shortest in seconds.items()}
    ratios = {index: rate / rates[0] for index, rate in rates.items() if 0 in rates}
    return [
        dataclasses.replace(each, steps_per_second=rates.get(index), ratio=ratios.get(index), missing=missing[index])
        for index, each in enumerate(measured)
    ]


def _missing(extras: Sequence[str]) -> str | None:
    """The command that installs some extras, or None where they are installed."""
    try:
        for extra in extras:
            for package in PACKAGES[extra]:
                require(package, extra)
    except BadInput:
        return f'pip install "flytune[{",".join(extras)}]"'
    return None


def fastest(runs: Sequence[Repeat], clock: Callable[[], float] = time.perf_counter) -> list[float]:
    """Seconds of the fastest repetition of each function, see `repetitions`.

    Other load on the machine only ever makes a repetition slower.
    """
    return [min(seconds) for seconds in repetitions(runs, clock)]


def repetitions(runs: Sequence[Repeat], clock: Callable[[], float] = time.perf_counter) -> list[list[float]]:
    """Seconds of each repetition of each function; a first repetition, which compiles, does not count."""
    for run in runs:
        run()
    seconds: list[list[float]] = [[] for _ in runs]
    began = clock()
    for number in range(ROUNDS):
        if number and clock() - began > LONGEST:
            break
        for index, run in enumerate(runs):
            started = clock()
            run()
            seconds[index].append(clock() - started)
    return seconds


def make_environment(task: Task) -> Any:
    """The environment of the baseline: flytune's for Gymnasium, in PyBullet, in Stable-Baselines3's monitor."""
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
    """Steps of PyBullet's physics, without an environment around it."""
    from flytune.simulation.simulators import make_simulator

    simulator, actions = make_simulator("pybullet", task.vehicle, 1), _actions(1)

    def run() -> None:
        for action in actions:
            simulator.advance(action)
            simulator.states()

    yield run
    simulator.close()
