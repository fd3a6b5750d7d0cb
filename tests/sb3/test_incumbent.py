"""The comparison with the incumbent: what is not installed is named, and ratios are to the first row."""

import pytest

pytest.importorskip("stable_baselines3", reason="needs flytune[sb3]")

import contextlib
import dataclasses
import sys

from flytune.bridges.sb3 import HoverVecEnv
from flytune.errors import BadInput
from flytune.learn import incumbent
from flytune.task.task import load_task


def test_what_is_not_installed_is_named_with_its_command_and_has_no_rate(monkeypatch):
    for package, extras in [("pybullet", ("pybullet", "sb3")), ("stable_baselines3", ("sb3",))]:
        with monkeypatch.context() as patch:
            patch.setitem(sys.modules, package, None)
            row = incumbent._row("A on B", (4, 1024), 4, lambda: 850.0, *extras)
        command = f'pip install "flytune[{",".join(extras)}]"'
        assert (row.steps_per_second, row.ratio, row.missing) == (None, None, command)
        assert "not installed" in row.line() and command in row.line() and "4 x 1024" in row.line()


def test_what_is_installed_has_a_rate_and_its_ratio_to_the_first_row():
    rates = {"first": 850.0, "second": 1700.0}
    rows = [incumbent._row(name, (4, 10), 1, lambda rate=rate: rate, "sb3") for name, rate in rates.items()]
    first, second = incumbent._with_ratios(rows)
    assert (first.ratio, second.ratio) == (1.0, 2.0) and second.missing is None
    assert "1,700 steps/s" in second.line() and "2.0 x" in second.line()


def test_without_the_incumbent_there_is_no_ratio():
    rows = [incumbent._row("A", (1, 1), 1, lambda: 3.0), incumbent._row("B", (1, 1), 1, lambda: 6.0)]
    without = dataclasses.replace(rows[0], steps_per_second=None, missing="x")
    assert incumbent._with_ratios([without, rows[1]])[1].ratio is None


def test_a_refusal_that_is_no_missing_package_is_not_taken_for_one():
    def refuse():
        raise BadInput("world: 'x' is not allowed.")

    with pytest.raises(BadInput, match="not allowed"):
        incumbent._row("A", (1, 1), 1, refuse)


def test_a_vector_of_environments_is_timed_over_all_its_steps(monkeypatch):
    monkeypatch.setattr(incumbent, "STEPS", 20)
    monkeypatch.setattr(incumbent, "UPDATES", 2)
    counted = []

    class Counting(HoverVecEnv):
        def step_wait(self):
            counted.append(self.num_envs)
            return super().step_wait()

    task = load_task("baseline")
    rate = incumbent._step_vector(lambda number: contextlib.nullcontext(Counting(task, number)), 3)
    assert counted == [3] * 60  # one repetition that is not counted, and two that are
    assert rate > 0
