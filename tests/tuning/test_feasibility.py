"""Bounds that no controller beats: hand-worked numbers, a bang-bang flight, and requirements that physics forbids."""

import numpy as np
import pytest

from flytune.control.classical import classical_controller
from flytune.errors import BadInput
from flytune.evaluation.fly import fly
from flytune.evaluation.judge import judge
from flytune.task.task import load_task
from flytune.tuning.feasibility import check_possible, thrust_bound
from flytune.tuning.requirement import make_requirement


def test_a_start_inside_the_band_needs_no_time():
    np.testing.assert_array_equal(thrust_bound(np.array([0.0, 0.02]), 10.0, 10.0), [0.0, 0.0])


def test_a_long_way_takes_as_long_as_full_thrust_and_full_brake():
    # ahead = back = 10: 2 m in 2 sqrt(2 / 10) = 0.894 s to rest; arriving with sqrt(2 * 10 * 0.04) = 0.894 m/s instead:
    # peak^2 / 20 + (peak^2 - 0.8) / 20 = 2 gives peak = sqrt(20.4) = 4.5166, t = 0.45166 + 0.45166 - 0.0894 = 0.8139 s
    assert thrust_bound(np.array([2.02]), 10.0, 10.0)[0] == pytest.approx(0.8139, abs=1e-4)


def test_a_short_way_needs_no_brake():
    # 0.03 m at 10 m/s^2 end with 0.775 m/s, less than the 0.894 m/s that can be lost inside the band
    assert thrust_bound(np.array([0.05]), 10.0, 10.0)[0] == pytest.approx(np.sqrt(2 * 0.03 / 10))


def test_no_flight_of_a_point_mass_beats_the_bound():
    # random switching of full thrust ahead and back along a line, many times: none settles earlier
    generator = np.random.default_rng(0)
    distance, ahead, back = 1.0, 12.0, 6.0
    least = thrust_bound(np.array([distance]), ahead, back)[0]
    step, settled = 0.001, []
    for switch in generator.uniform(0.1, 0.5, 2000):
        time = np.arange(0, 3, step)
        acceleration = np.where(time < switch, ahead, -back)
        speed = np.maximum(np.cumsum(acceleration) * step, 0.0)  # it stops, and stays where it stops
        left = distance - np.cumsum(speed) * step
        outside = np.abs(left) > 0.02
        if not outside[-1]:
            settled.append(time[outside].max())
    assert len(settled) > 20
    assert min(settled) >= least - 2 * step


def test_no_classical_pilot_beats_its_bound():
    task = load_task("acrobatic")
    flights = fly(classical_controller("lqr", task, "tuned"), task, trials=40, seed=3)
    judged = judge(flights)
    way = flights.target_position - flights.position[:, 0]
    distance = np.linalg.norm(way, axis=1)
    thrust = float(task.vehicle.thrust_to_weight) * 9.81
    climb = way[:, 2] / distance
    bound = thrust_bound(distance, thrust - 9.81 * climb, thrust + 9.81 * climb)
    assert (judged.settling_time["position"] >= bound).all()


@pytest.fixture(scope="module")
def flights():
    task = load_task("baseline")
    return fly(classical_controller("pid", task, "tuned"), task, trials=60, seed=3, duration=0.6)


def test_a_wish_beyond_the_thrust_is_refused_with_the_bound(flights):
    with pytest.raises(
        BadInput, match=r"settling-time: 0\.3 s is not possible: with a thrust of 2\.25 times the weight"
    ):
        check_possible(load_task("baseline"), make_requirement(0.3), flights, ())


def test_a_wish_beyond_the_users_own_speed_bound_is_refused_and_one_beyond_a_presets_is_not(flights):
    task = load_task("baseline")
    with pytest.raises(BadInput, match=r"speed bound of 0\.8 m/s you have set.*needs at least [12]\.\d+ s over [12]\."):
        check_possible(task, make_requirement(1), flights, ("termination.speed.bound",))
    check_possible(task, make_requirement(1), flights, ())
    check_possible(task, make_requirement(4), flights, ("termination.speed.bound",))


def test_the_allowed_time_that_is_named_is_allowed(flights):
    task, fixed = load_task("baseline"), ("termination.speed.bound",)
    with pytest.raises(BadInput) as refusal:
        check_possible(task, make_requirement(1), flights, fixed)
    allowed = float(str(refusal.value).split("Allowed: ")[1].split(" s")[0])
    check_possible(task, make_requirement(allowed), flights, fixed)


def test_yaw_is_bounded_by_the_users_rate_bound(flights):
    task = load_task("baseline", {"termination.body_rate.bound_deg_per_s": 30})
    wanted = make_requirement(1, axis="yaw")
    with pytest.raises(BadInput, match=r"body rate bound of 30 deg/s you have set"):
        check_possible(task, wanted, flights, ("termination.body_rate.bound_deg_per_s",))
    check_possible(task, wanted, flights, ())
