"""What trainers share: the choice of threads by the cores that are free."""

import os
import time

import pytest

from flytune.cli.main import main
from flytune.training.threads import BusyCores, cores, in_threads


def threads_of(busy, number, work=lambda threads: None):
    """The numbers of threads that so many problems were given."""
    used = []
    for _ in range(number):
        busy.run(lambda threads: (used.append(threads), work(threads)))
    return used


def test_one_thread_works_where_a_training_may_use_one_core(monkeypatch):
    monkeypatch.setenv("FLYTUNE_CORES", "1")
    assert cores() == 1
    assert threads_of(BusyCores(), 3) == [1, 1, 1]


@pytest.mark.skipif(cores() < 2, reason="needs two cores")
def test_after_two_threads_that_had_no_core_of_their_own_one_works_for_a_while():
    # a sleep needs no processor: as if other programs had both cores
    used = threads_of(BusyCores(), 2 * BusyCores.PAUSE + 3, lambda threads: time.sleep(0.005))
    assert used == [2, *[1] * BusyCores.PAUSE, 2, *[1] * BusyCores.PAUSE, 2]


@pytest.mark.skipif(cores() < 2, reason="needs two cores")
def test_two_threads_go_on_while_both_have_a_core(monkeypatch):
    monkeypatch.setattr(BusyCores, "FREE", 0.0)  # whatever else this machine does
    assert threads_of(BusyCores(), 4) == [2] * 4


@pytest.mark.parametrize(("wanted", "found"), [("1", 1), (" 1 ", 1), ("1000", None), ("", None), (" ", None)])
def test_the_environment_lowers_the_number_of_cores_and_never_raises_it(monkeypatch, wanted, found):
    free = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    monkeypatch.setenv("FLYTUNE_CORES", wanted)
    assert cores() == (found or free)


@pytest.mark.parametrize("wanted", ["0", "-1", "two", "1.5", "²", "1e3"])
@pytest.mark.parametrize("command", [["train", "baseline"], ["tune", "--settling-time", "3"], ["reproduce"]])
def test_a_number_of_cores_that_is_none_is_refused_before_anything_is_written(
    monkeypatch, tmp_path, capsys, wanted, command
):
    monkeypatch.setenv("FLYTUNE_CORES", wanted)
    out = tmp_path / "out"
    assert main([*command, "--out", str(out)]) == 2
    assert capsys.readouterr().err == (
        f"FLYTUNE_CORES: {wanted!r} is not allowed. Allowed: a whole number, 1 or more. Set another, or unset it.\n"
    )
    assert not out.exists()


def test_a_failure_in_one_part_is_the_callers():
    def part(index):
        if index == 1:
            raise ValueError("the second part")
        return index

    with pytest.raises(ValueError, match="the second part"):
        in_threads(part, 2, None)
