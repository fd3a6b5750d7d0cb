"""Evaluating several controllers: all fly one task, and a policy of another vehicle is named."""

import dataclasses

import pytest

import flytune
from flytune.evaluation.evaluate import shared_task

OWN = {"vehicle.mass": 0.035, "target.position": [0.5, 0.0, 1.2], "duration": 3.0}


@pytest.fixture(scope="module")
def mine(tmp_path_factory):
    """A policy file with the weights of the baseline and a task of its own: a heavier vehicle, elsewhere, for 3 s."""
    path = tmp_path_factory.mktemp("policy") / "mine.safetensors"
    policy = flytune.find_controller("baseline-refined").controller
    task = dataclasses.replace(flytune.load_task("baseline", OWN), name="mine")
    about = {"task": "mine", "vehicle": "crazyflie", "task_toml": flytune.write_task(task)}
    flytune.save_policy(path, dataclasses.replace(policy, about=about))
    return str(path)


def one_task(evaluations):
    assert len({(each.task.name, each.judgement.duration, float(each.task.vehicle.mass)) for each in evaluations}) == 1
    assert len({tuple(each.flights.target_position.tolist()) for each in evaluations}) == 1
    starts = [each.flights.position[:, 0].tolist() for each in evaluations]
    assert all(start == starts[0] for start in starts)
    return evaluations[0].task


@pytest.mark.parametrize("order", [slice(None), slice(None, None, -1)])
def test_classical_controllers_fly_the_task_and_the_vehicle_of_the_policy_beside_them_in_any_order(mine, order):
    evaluations = flytune.evaluate_all([mine, "pid", "lqr"][order], trials=2)
    task = one_task(evaluations)
    assert task.name == "mine" and float(task.vehicle.mass) == pytest.approx(0.035)
    assert all(each.judgement.made_for == "" for each in evaluations)
    alone = flytune.evaluate("pid", flytune.find_controller(mine).task, trials=2)  # a PID made for that vehicle
    (beside,) = (each for each in evaluations if each.name == "pid")
    assert (beside.flights.position == alone.flights.position).all()


def test_the_first_learned_policy_gives_the_task_and_another_vehicle_is_named(mine):
    evaluations = flytune.evaluate_all(["pid", "baseline-refined", mine], trials=1, duration=1.0)
    assert one_task(evaluations).name == "baseline-refined"
    assert [each.judgement.made_for for each in evaluations] == ["", "", "crazyflie with another mass"]
    comparison = flytune.compare([each.judgement for each in evaluations])
    first_line = str(comparison).splitlines()[0]
    assert "task baseline-refined; vehicle crazyflie;" in first_line
    assert (
        f"{mine} was trained on crazyflie with another mass: its actions are relative to the hover speed" in first_line
    )
    assert evaluations[2].judgement.to_dict()["made_for"] == "crazyflie with another mass"
    assert "made for crazyflie with another mass" in str(evaluations[2])


def test_a_task_that_is_given_is_flown_by_all_and_without_any_policy_it_is_the_baseline(mine):
    assert one_task(flytune.evaluate_all([mine, "pid"], "acrobatic", trials=1, duration=1.0)).name == "acrobatic"
    assert one_task(flytune.evaluate_all(["pid", "lqr"], trials=1, duration=1.0)).name == "baseline"
    assert [shared_task(names)[1] for names in (["pid", mine], ["pid", "lqr"], ["pid"])] == [mine, "", "pid"]
    assert shared_task(["pid", mine], "acrobatic")[1] is None


def test_a_policy_flies_the_vehicle_that_it_was_trained_on_wherever_its_task_is_not_changed():
    other = flytune.evaluate(
        "baseline-refined", flytune.load_task("baseline", {"vehicle": "crazyflie-measured"}), trials=1
    )
    assert other.judgement.made_for == "crazyflie"
    assert flytune.evaluate("baseline-refined", "acrobatic", trials=1).judgement.made_for == ""
