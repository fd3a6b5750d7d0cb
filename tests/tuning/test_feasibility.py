"""Feasibility: requirements that no controller can meet are refused with the bound and its cause."""

import pytest

from flytune.control.classical import classical_controller
from flytune.errors import BadInput
from flytune.evaluation.fly import fly
from flytune.task.files import load_task
from flytune.tuning.asked import make_requirement
from flytune.tuning.feasibility import check_feasible


@pytest.fixture(scope="module")
def flights():
    task = load_task("baseline")
    return fly(classical_controller("pid", task, "tuned"), task, trials=60, seed=3, duration=0.6)


def test_a_requirement_beyond_the_thrust_is_refused_with_the_bound(flights):
    with pytest.raises(
        BadInput, match=r"settling-time: 0\.3 s is not possible: with a thrust of 2\.25 times the weight"
    ):
        check_feasible(load_task("baseline"), make_requirement(0.3), flights, ())


def test_the_users_own_speed_bound_is_a_constraint_and_that_of_a_preset_is_not(flights):
    task = load_task("baseline")
    with pytest.raises(BadInput, match=r"speed bound of 0\.8 m/s you have set.*takes at least [12]\.\d+ s over [12]\."):
        check_feasible(task, make_requirement(1), flights, ("termination.speed.bound",))
    check_feasible(task, make_requirement(1), flights, ())
    check_feasible(task, make_requirement(4), flights, ("termination.speed.bound",))


def test_the_allowed_time_that_is_named_is_allowed(flights):
    task, fixed = load_task("baseline"), ("termination.speed.bound",)
    with pytest.raises(BadInput) as refusal:
        check_feasible(task, make_requirement(1), flights, fixed)
    allowed = float(str(refusal.value).split("Allowed: ")[1].split(" s")[0])
    check_feasible(task, make_requirement(allowed), flights, fixed)


def test_yaw_is_bounded_by_the_users_rate_bound(flights):
    task = load_task("baseline", {"termination.body_rate.bound_deg_per_s": 30})
    wanted = make_requirement(1, axis="yaw")
    with pytest.raises(BadInput, match=r"body rate bound of 30 deg/s you have set"):
        check_feasible(task, wanted, flights, ("termination.body_rate.bound_deg_per_s",))
    check_feasible(task, wanted, flights, ())
