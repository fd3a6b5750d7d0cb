"""Physical bounds with their arithmetic, and who counts as infeasible."""

import math

import numpy as np
import pytest

from flytune.evaluation import lower_bounds


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
