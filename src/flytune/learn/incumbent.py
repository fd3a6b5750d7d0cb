"""Throughput beside what people use today: Stable-Baselines3 and PyBullet, measured on this machine in the same run."""

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

PROCESSES = 4  # of the incumbent (paper R18)
UPDATES, LONGEST = 5, 25.0  # repetitions of a measurement, fewer where they take longer (s); the fastest counts
ROLLOUT = 1024  # steps per environment and update with 4 environments; the paper's 4,096 give the same rate
STEPS = 2000  # per environment in one repetition of a simulation


@dataclasses.dataclass(frozen=True, kw_only=True)
class Row:
    """One measurement; `ratio` is to the incumbent, the first row of its kind."""

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


def compare_training(task: Task, own: float) -> list[Row]:
    """Training by Stable-Baselines3 on PyBullet, on our environments, and by our own PPO, whose rate is `own`."""
    settings = task.ppo
    small, usual = (PROCESSES, ROLLOUT), (settings.environments, settings.rollout)
    pybullet, own_environments = partial(_pybullet_processes, task), partial(_own_environments, task)
    return _with_ratios(
        [
            _row("SB3 PPO on PyBullet", small, PROCESSES, partial(_train, task, pybullet, small), "pybullet", "sb3"),
            _row("SB3 PPO on flytune", small, 1, partial(_train, task, own_environments, small), "sb3"),
            _row("SB3 PPO on flytune", usual, 1, partial(_train, task, own_environments, usual), "sb3"),
            _row("flytune PPO", usual, 1, lambda: own),
        ]
    )


def compare_simulation(task: Task, own: float, own_shape: tuple[int, int]) -> list[Row]:
    """Simulation in PyBullet, by our environments for other people's trainers, and compiled as a whole (`own`)."""
    processes, width = partial(_pybullet_processes, task), task.ppo.environments
    return _with_ratios(
        [
            _row("PyBullet, Gymnasium, SubprocVecEnv", (PROCESSES, STEPS), PROCESSES,
                 partial(_step_vector, processes, PROCESSES), "pybullet", "sb3"),
            _row("PyBullet, Gymnasium", (1, STEPS), 1, lambda: _step_single(task, "pybullet")[0], "pybullet"),
            _row("PyBullet alone, without Gymnasium", (1, STEPS), 1, lambda: _step_single(task, "pybullet")[1],
                 "pybullet"),
            _row("flytune, Gymnasium", (1, STEPS), 1, lambda: _step_single(task, "flytune")[0], "gymnasium"),
            _row("flytune, VecEnv", (width, STEPS), 1,
                 partial(_step_vector, partial(_own_environments, task), width), "sb3"),
            _row("flytune, compiled", own_shape, 1, lambda: own),
        ]
    )  # fmt: skip


def _row(what: str, shape: tuple[int, int], processes: int, measure: Callable[[], float], *extras: str) -> Row:
    packages = {
        "pybullet": ("pybullet", "gymnasium"),
        "sb3": ("torch", "stable_baselines3"),
        "gymnasium": ("gymnasium",),
    }
    missing, rate = None, None
    try:
        for extra in extras:
            for package in packages[extra]:
                require(package, extra)
        rate = measure()
    except BadInput as error:
        if "is not installed" not in str(error):
            raise
        missing = f'pip install "flytune[{",".join(extras)}]"'
    environments, steps = shape
    return Row(
        what=what,
        environments=environments,
        steps=steps,
        processes=processes,
        steps_per_second=rate,
        missing=missing,
    )


def _with_ratios(rows: list[Row]) -> list[Row]:
    base = rows[0].steps_per_second

    def ratio(row: Row) -> float | None:
        return row.steps_per_second / base if base and row.steps_per_second else None

    return [dataclasses.replace(row, ratio=ratio(row)) for row in rows]


def _fastest(once: Callable[[], Any]) -> float:
    """Seconds of the fastest of some repetitions, after one that is not counted."""
    once()
    times, began = [], time.perf_counter()
    while len(times) < UPDATES and (not times or time.perf_counter() - began < LONGEST):
        started = time.perf_counter()
        once()
        times.append(time.perf_counter() - started)
    return min(times)


def make_environment(task: Task) -> Any:
    """The incumbent's environment: ours for Gymnasium with PyBullet's physics, monitored as SB3 would."""
    from stable_baselines3.common.monitor import Monitor

    from flytune.bridges.gymnasium import HoverEnv

    return Monitor(HoverEnv(task, world="pybullet"))


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
    from flytune.bridges.sb3 import HoverVecEnv

    yield HoverVecEnv(task, number)


def _train(task: Task, environments: Callable[[int], Any], shape: tuple[int, int]) -> float:
    """Environment steps per second of Stable-Baselines3's PPO with the task's settings, rollouts and epochs."""
    import torch

    from flytune.learn.sb3 import make_model

    number, rollout = shape
    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # faster at this size, for the incumbent too
    try:
        with environments(number) as made:
            settings = dataclasses.replace(task.ppo, environments=number, rollout=rollout)
            model = make_model(settings, made, seed=0)
            return number * rollout / _fastest(lambda: model.learn(number * rollout, reset_num_timesteps=False))
    finally:
        torch.set_num_threads(threads)


def _step_vector(environments: Callable[[int], Any], number: int) -> float:
    generator = np.random.default_rng(0)
    actions = generator.uniform(-0.3, 0.3, (STEPS, number, 4)).astype(np.float32)
    with environments(number) as made:
        made.reset()

        def once() -> None:
            for action in actions:
                made.step(action)

        return number * STEPS / _fastest(once)


def _step_single(task: Task, world: str) -> tuple[float, float]:
    """Steps per second of one environment, and of the physics in it without what makes it an environment."""
    from flytune.bridges.gymnasium import HoverEnv
    from flytune.bridges.worlds import make_world

    environment = HoverEnv(task, world=world)
    actions = np.random.default_rng(0).uniform(-0.3, 0.3, (STEPS, 4)).astype(np.float32)
    environment.reset(seed=0)

    def once() -> None:
        for action in actions:
            _, _, terminated, truncated, _ = environment.step(action)
            if terminated or truncated:
                environment.reset()

    whole = _fastest(once)
    environment.close()
    simulator = make_world(world, task.vehicle, 1)

    def physics() -> None:
        for action in actions:
            simulator.advance(action[None])
            simulator.body()

    alone = _fastest(physics)
    simulator.close()
    return STEPS / whole, STEPS / alone
