"""The comparison with the baseline: what is not installed is named, and ratios are to the first row."""

import pytest

pytest.importorskip("stable_baselines3", reason="needs flytune[sb3]")

import contextlib
import sys

from flytune.adapters.vec_env import HoverVecEnv
from flytune.benchmark import baselines
from flytune.task.files import load_task


def case(what, run=lambda: None, extras=()):
    measurement = baselines.Measurement(what=what, environments=4, steps=1024)
    return baselines.Case(measurement, lambda: contextlib.nullcontext(run), extras)


@pytest.mark.parametrize(("package", "extras"), [("pybullet", ("pybullet", "sb3")), ("stable_baselines3", ("sb3",))])
def test_what_is_not_installed_is_named_with_its_command_and_has_no_rate(monkeypatch, package, extras):
    monkeypatch.setitem(sys.modules, package, None)
    lacking, there = baselines.measure([case("A on B", extras=extras), case("B")])
    command = f'pip install "flytune[{",".join(extras)}]"'
    assert (lacking.steps_per_second, lacking.ratio, lacking.missing) == (None, None, command)
    assert there.steps_per_second > 0 and there.ratio is None
    _, line, other = str(baselines.measurements_table([lacking, there])).splitlines()
    assert line.split() == ["A", "on", "B", "4", "1024", "1", "-", "-", "not", "installed:", *command.split()]
    assert other.split() == ["B", "4", "1024", "1", f"{there.steps_per_second:,.0f}", "-"]


def test_rates_are_those_of_the_fastest_repetition_and_ratios_are_to_the_first():
    now = 0.0
    durations = {"slow": iter([9.0, 4.0, 2.0, 5.0, 2.0, 3.0]), "fast": iter([0.1, 1.0, 0.5, 2.0, 3.0, 1.0])}

    def taking(name):
        def run():
            nonlocal now
            now += next(durations[name])

        return case(name, run, extras=("sb3",))

    slow, fast = baselines.measure([taking("slow"), taking("fast")], clock=lambda: now)
    # 4 x 1024 steps in 2 s and in 0.5 s; the first repetition compiles and does not count, however short it is
    assert (slow.steps_per_second, fast.steps_per_second) == (2048, 8192)
    assert (slow.ratio, fast.ratio) == (1, 4)
    lines = str(baselines.measurements_table([slow, fast])).splitlines()
    assert [line.split()[4:] for line in lines[1:]] == [["2,048", "1.0", "x"], ["8,192", "4.0", "x"]]


def test_measurements_take_turns():
    order = []
    baselines.measure([case(name, lambda name=name: order.append(name)) for name in "ab"])
    assert order == list("ab" * (1 + baselines.ROUNDS))


def test_a_repetition_steps_every_environment_and_an_update_learns_from_them(monkeypatch):
    monkeypatch.setattr(baselines, "STEPS", 20)
    counted = []

    class Counting(HoverVecEnv):
        def step_wait(self):
            counted.append(self.num_envs)
            return super().step_wait()

    task = load_task("baseline", {"ppo.environments": 3, "ppo.rollout": 8, "ppo.minibatch": 24, "ppo.epochs": 1})

    def made(number):
        return contextlib.nullcontext(Counting(task, number))

    with baselines._stepping(made, 3) as run:
        run()
    assert counted == [3] * 20
    with baselines._training(task, made, 3, 8) as run:
        model = run()
    assert counted[20:] == [3] * 8 and model.num_timesteps == 24


def test_the_simulators_compared_are_there_to_be_timed(monkeypatch):
    pytest.importorskip("pybullet", reason="needs flytune[pybullet]")
    monkeypatch.setattr(baselines, "STEPS", 30)
    task = load_task("baseline")
    for prepare in (baselines._one(task, "pybullet"), baselines._one(task, "flytune"), baselines._alone(task)):
        with prepare as run:
            run()
