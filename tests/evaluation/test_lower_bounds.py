"""Physical bounds with their arithmetic, and who counts as infeasible."""

import math

import numpy as np
import pytest

from flytune.control.classical import classical_controller
from flytune.evaluation import lower_bounds
from flytune.evaluation.fly import fly
from flytune.evaluation.judge import judge
from flytune.task.files import load_task


def test_the_bound_is_the_way_to_the_edge_of_the_band_at_the_speed_bound():
    # (1.62 - 0.02) m / 0.8 m/s = 2 s; a start inside the band needs no time
    np.testing.assert_allclose(lower_bounds.settling_time_bound(np.array([1.62, 0.02, 0.005]), 0.8), [2.0, 0.0, 0.0])


def test_without_a_speed_bound_no_time_is_too_short():
    np.testing.assert_array_equal(lower_bounds.settling_time_bound(np.array([1.62, 100.0]), None), [0.0, 0.0])


def test_a_trial_is_infeasible_when_its_bound_leaves_less_than_half_a_second():
    bound = np.array([9.4, 9.5, 9.6])
    assert lower_bounds.infeasible(bound, 10.0, {}).tolist() == [False, False, True]


def test_a_start_in_violation_is_infeasible_and_a_start_on_the_bound_is_not():
    height = np.array(
        [[-0.1, 1.0], [0.0, 1.0], [0.5, -0.5]]
    )  # the last one leaves later, which is the controller's doing
    tilt = np.array([[0.3, 0.3], [0.3, 0.3], [0.3, 0.3]])
    flags = lower_bounds.infeasible(np.zeros(3), 10.0, {"tilt": tilt, "height": height})
    assert flags.tolist() == [True, False, False]


def test_the_share_of_far_inspection_starts_matches_the_published_count():
    # Uniform starts in +-2 m, z in [0, 2] m: 98 % of the way takes more than 10 s at 0.2 m/s for 24.9 % of them (C2).
    # With the band of 0.02 m and the half second that settling needs, the reach is 0.2 * 9.5 + 0.02 = 1.92 m.
    generator = np.random.default_rng(0)
    start = np.column_stack([generator.uniform(-2, 2, (200_000, 2)), generator.uniform(-1, 1, 200_000)])
    distance = np.linalg.norm(start, axis=1)
    assert np.mean(0.98 * distance / 0.2 > 10) == pytest.approx(0.249, abs=0.003)
    flagged = lower_bounds.infeasible(lower_bounds.settling_time_bound(distance, 0.2), 10.0, {})
    np.testing.assert_array_equal(flagged, distance > 1.92)


def test_efficiency_is_the_bound_over_the_measured_time():
    # above 1 only by breaking the speed bound; 0 if never settled; no value where there was no way to go
    bound = np.array([2.0, 2.0, 2.0, 0.0, 0.0])
    settled = np.array([4.0, 1.6, math.inf, 0.0, math.inf])
    np.testing.assert_array_equal(lower_bounds.efficiency(bound, settled), [0.5, 1.25, 0.0, math.nan, math.nan])


def test_by_thrust_a_start_inside_the_band_needs_no_time():
    np.testing.assert_array_equal(lower_bounds.thrust_bound(np.array([0.0, 0.02]), 10.0, 10.0), [0.0, 0.0])


def test_a_long_way_takes_as_long_as_full_thrust_and_full_brake():
    # ahead = back = 10: 2 m in 2 sqrt(2 / 10) = 0.894 s to rest; arriving with sqrt(2 * 10 * 0.04) = 0.894 m/s instead:
    # peak^2 / 20 + (peak^2 - 0.8) / 20 = 2 gives peak = sqrt(20.4) = 4.5166, t = 0.45166 + 0.45166 - 0.0894 = 0.8139 s
    assert lower_bounds.thrust_bound(np.array([2.02]), 10.0, 10.0)[0] == pytest.approx(0.8139, abs=1e-4)


def test_a_short_way_needs_no_brake():
    # 0.03 m at 10 m/s^2 end with 0.775 m/s, less than the 0.894 m/s that can be lost inside the band
    assert lower_bounds.thrust_bound(np.array([0.05]), 10.0, 10.0)[0] == pytest.approx(np.sqrt(2 * 0.03 / 10))


def test_no_flight_of_a_point_mass_beats_the_bound():
    # random switching of full thrust ahead and back along a line, many times: none settles earlier
    generator = np.random.default_rng(0)
    distance, ahead, back = 1.0, 12.0, 6.0
    least = lower_bounds.thrust_bound(np.array([distance]), ahead, back)[0]
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


def test_no_classical_controller_beats_its_bound():
    task = load_task("acrobatic")
    flights = fly(classical_controller("lqr", task, "tuned"), task, trials=40, seed=3)
    judged = judge(flights)
    way = flights.target_position - flights.position[:, 0]
    distance = np.linalg.norm(way, axis=1)
    thrust = float(task.vehicle.full_thrust_to_weight) * 9.81
    climb = way[:, 2] / distance
    bound = lower_bounds.thrust_bound(distance, thrust - 9.81 * climb, thrust + 9.81 * climb)
    assert (judged.settling_time["position"] >= bound).all()


def test_the_bound_of_a_yaw_is_in_radians_with_a_band_of_its_own():
    # (0.5 - 0.1) rad / 0.2 rad/s = 2 s
    np.testing.assert_allclose(lower_bounds.settling_time_bound(np.array([0.5, 0.05]), 0.2, 0.1), [2.0, 0.0])
